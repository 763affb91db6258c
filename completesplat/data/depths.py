"""True depth of the scenes of an evaluation, where the data have it."""

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.loading.module import SceneDataModule


def evaluation_depths(data: SceneDataModule, split: str, name: str) -> Float[Tensor, "view 1 height width"] | None:
    """Depth along the optical axes, in units of the cameras, of the reference and all targets; 0 where it is unknown.

    None where the data set has no depth, or only the pictures of it were prepared.

    Args:
        name: of the scene.

    Raises:
        DataError: a depth map cannot be read.
    """
    sequence = data.store(split).source.read(name)
    if sequence.read_depth is None:
        return None
    reference, targets = data.evaluation_views(sequence, split)
    return torch.stack([sequence.read_depth(view) for view in (reference, *targets)])
