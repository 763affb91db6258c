"""Cameras of several photos of one object that are known by the angles from which they were taken."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras, look_at

Mask = Float[Tensor, "1 size size"]
UP = (0.0, 0.0, 1.0)


def cameras_by_angles(
    intrinsics: Float[Tensor, "view 3 3"],
    size: int,
    angles: Sequence[float],
    elevations: Sequence[float],
    distances: Sequence[float],
) -> Cameras:
    """Return cameras [view] that look at one point from around it, in the frame of the first.

    Args:
        angles: in degrees around the point; a larger one is farther to the camera's right.
        elevations: in degrees above the horizon.
        distances: from the point.
    """
    azimuth = torch.tensor(angles, dtype=torch.float64).deg2rad()
    elevation = torch.tensor(elevations, dtype=torch.float64).deg2rad()
    level = elevation.cos()
    directions = torch.stack([level * azimuth.cos(), level * azimuth.sin(), elevation.sin()], dim=-1)
    eyes = torch.tensor(distances, dtype=torch.float64)[:, None] * directions
    matrices = look_at(eyes, torch.zeros_like(eyes), torch.tensor(UP, dtype=torch.float64))
    cameras = Cameras(matrices, intrinsics.double(), (size, size))
    return cameras.relative_to(cameras[0]).to(torch.float32)


def up_of_first(elevation: float) -> Float[Tensor, "3"]:
    """Return the direction up in the frame of a level-held camera that looks down by an angle in degrees."""
    angle = torch.tensor(elevation).deg2rad()
    return torch.stack([torch.zeros(()), -angle.cos(), -angle.sin()])


def distances_by_size(
    masks: Sequence[Mask | None], intrinsics: Float[Tensor, "view 3 3"], angles: Sequence[float]
) -> list[float]:
    """Return how far away each photo was taken, relative to the first, if the object is equally high in all.

    Args:
        masks: the object in each photo; if one is None, all distances are 1.
        angles: name the photos in messages.

    Raises:
        CompleteSplatError: a mask is empty.
    """
    heights = []
    for mask, matrix, angle in zip(masks, intrinsics, angles, strict=True):
        if mask is None:
            return [1.0] * len(masks)
        rows = int((mask[0] > 0.5).any(dim=1).sum())
        if not rows:
            raise CompleteSplatError(f"the photo at {angle:g} degrees shows no object")
        heights.append(rows / matrix[1, 1].item())
    return [heights[0] / height for height in heights]
