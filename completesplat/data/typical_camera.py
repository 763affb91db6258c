"""The camera of a typical training picture: what is assumed of a photograph that says nothing about its own."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras


class TypicalCamera(NamedTuple):
    """Means over the training pictures.

    Attributes:
        fov_degrees: horizontal field of view.
        depth_range: near and far, in scene units.
        up: the direction away from the ground in the camera's frame, a unit vector.
    """

    fov_degrees: float
    depth_range: tuple[float, float]
    up: tuple[float, float, float]


def typical_camera(sequences: Sequence[Cameras], depth_ranges: Sequence[Float[Tensor, "_ 2"]]) -> TypicalCamera:
    """Average over all cameras of all sequences, each [view]."""
    focal = torch.cat([cameras.intrinsics[:, 0, 0] for cameras in sequences])
    width = sequences[0].image_size[1]
    near, far = torch.cat(list(depth_ranges)).mean(dim=0).tolist()
    ups = torch.cat([cameras.world_to_camera[:, :3, :3] @ world_up(cameras) for cameras in sequences])
    x, y, z = torch.nn.functional.normalize(ups.mean(dim=0), dim=0).tolist()
    return TypicalCamera(2 * torch.atan(0.5 * width / focal).mean().rad2deg().item(), (near, far), (x, y, z))


def world_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """The up direction of a sequence of hand-held cameras [view], in world coordinates.

    People hold cameras level: the direction to which all horizontal image axes are most nearly perpendicular, on the
    side of the cameras' own up (after `co3d_normalisation.py` of Splatter Image).
    """
    horizontal, down = cameras.world_to_camera[:, 0, :3], cameras.world_to_camera[:, 1, :3]
    up = torch.linalg.svd(horizontal).Vh[-1]
    return torch.where(down.mean(dim=0) @ up > 0, -up, up)
