"""Camera paths for videos, contact sheets and the viewer."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras, look_at


def orbit(
    reference: Cameras, pivot: Float[Tensor, "3"], up: Float[Tensor, "3"], frames: int, degrees: float = 360.0
) -> Cameras:
    """Cameras that circle the axis through `pivot` along `up`, starting at the reference camera.

    The reference camera (unbatched) keeps its distance and height; every camera looks at `pivot`. The last frame
    stops one step short of `degrees`, so that a full turn loops smoothly.

    Returns:
        Cameras with a leading axis of `frames`, each to the right of the one before: for a positive angle the path
        runs counter-clockwise as seen from above.
    """
    axis = torch.nn.functional.normalize(up, dim=-1)
    angles = torch.arange(frames, dtype=up.dtype, device=up.device) / frames * math.radians(degrees)
    arm = reference.centers - pivot
    cos, sin = angles.cos()[:, None], angles.sin()[:, None]
    # Rodrigues' formula for the rotation of the arm about the axis.
    eyes = arm * cos + torch.linalg.cross(axis, arm) * sin + axis * (axis @ arm) * (1 - cos) + pivot
    world_to_camera = look_at(eyes, pivot.expand_as(eyes), axis.expand_as(eyes))
    intrinsics = reference.intrinsics.expand(frames, 3, 3)
    return replace(reference, world_to_camera=world_to_camera, intrinsics=intrinsics)
