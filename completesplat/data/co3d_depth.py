"""CO3D's depth maps in the square pictures and at the common scale."""

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.checks import at
from completesplat.data.co3d_annotations import CO3DFrame
from completesplat.data.images import read_depth
from completesplat.data.transforms import Square


def square_depth(frame: CO3DFrame, square: Square, size: int, factor: float) -> Float[Tensor, "1 size size"]:
    """Depth along the optical axis at the centre of each pixel of the square picture; 0 where it is unknown.

    The nearest pixel of the map counts: a mean across an edge would be the depth of nothing. The map may have another
    size than the picture that it belongs to.

    Args:
        factor: from the sequence's units to the common scale.

    Raises:
        DataError: the frame has no depth map, or it cannot be read.
    """
    if frame.depth is None:
        return torch.zeros(1, size, size)
    with at(frame=frame.number):
        depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
    places = []
    ends = zip(depth.shape, frame.camera.image_size, (square.top, square.left), strict=True)
    for count, side, start in ends:
        centers = start + (torch.arange(size, dtype=torch.float64) + 0.5) * square.side / size
        places.append((centers * count / side).long().clamp(0, count - 1))
    rows, columns = places
    return factor * depth[rows[:, None], columns][None]
