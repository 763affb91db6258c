"""Unit quaternions (w, x, y, z) and rotation matrices.

A zero quaternion stands for the identity rotation, with a zero gradient, everywhere in this project. So does
gsplat: it divides by the norm clamped from below, and the zero vector gives R = I.
"""

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST_NORM = 1e-12


def normalize_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale a quaternion to unit length, and turn a zero quaternion into (1, 0, 0, 0) with zero gradient."""
    squared = quaternion.square().sum(-1, keepdim=True)
    usable = squared > SMALLEST_NORM**2
    # The norm is taken of a sanitised value, so that the unused branch of `where` has a finite gradient too.
    norm = torch.where(usable, squared, torch.ones_like(squared)).sqrt()
    identity = torch.zeros_like(quaternion)
    identity[..., 0] = 1
    return torch.where(usable, quaternion / norm, identity)


def quaternion_to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of a quaternion of any length (it is normalised first)."""
    w, x, y, z = normalize_quaternion(quaternion).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*w.shape, 3, 3)


def matrix_to_quaternion(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the unit quaternion, with w >= 0, of a rotation matrix.

    The largest of the four components is found first and the others are divided by it, which keeps full
    precision for every rotation (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    m = matrix
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Four times the squared component, for w, x, y, z.
    squares = torch.cat([1 + trace[..., None], 1 + 2 * diagonal - trace[..., None]], dim=-1)
    wx = m[..., 2, 1] - m[..., 1, 2]
    wy = m[..., 0, 2] - m[..., 2, 0]
    wz = m[..., 1, 0] - m[..., 0, 1]
    xy = m[..., 1, 0] + m[..., 0, 1]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 1, 2] + m[..., 2, 1]
    ww, xx, yy, zz = squares.unbind(-1)
    rows = [[ww, wx, wy, wz], [wx, xx, xy, xz], [wy, xy, yy, yz], [wz, xz, yz, zz]]
    candidates = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    best = squares.argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = normalize_quaternion(candidates.gather(-2, best).squeeze(-2))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_multiply(
    left: Float[Tensor, "*#batch 4"], right: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Return the Hamilton product: the rotation `right` followed by the rotation `left`."""
    w1, x1, y1, z1 = left.unbind(-1)
    w2, x2, y2, z2 = right.unbind(-1)
    w = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2
    x = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    y = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
    z = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
    return torch.stack([w, x, y, z], dim=-1)
