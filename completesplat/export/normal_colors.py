"""Normal maps as colours."""

import torch
from jaxtyping import Float
from torch import Tensor


def color_normals(normals: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """(n + 1) / 2 of unit normals in the camera's frame, in the axes of normal maps: right, up, towards the viewer.

    What faces the camera is light blue (0.5, 0.5, 1), what faces right is red and what faces up is green. In the
    camera's own axes (+y down, +z forward) that is (1 + x, 1 - y, 1 - z) / 2. No normal (0) is grey.
    """
    signs = torch.tensor([1.0, -1.0, -1.0], dtype=normals.dtype, device=normals.device)
    return (normals * signs[:, None, None] + 1) / 2
