"""How faithful samples are to what is known."""

import math

from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras
from completesplat.metrics.images import PSNR_LIMIT


def object_psnr(
    images: Float[Tensor, "sample view 3 height width"],
    true: Float[Tensor, "view 3 height width"],
    masks: Float[Tensor, "view 1 height width"],
) -> float | None:
    """PSNR (dB) of the samples over the true object's pixels of all views together; None if there are none."""
    inside = (masks > 0.5).expand_as(true)
    if not inside.any():
        return None
    error = (images - true).square().mean(0)[inside].mean().item()
    return min(-10 * math.log10(error), PSNR_LIMIT) if error > 0 else PSNR_LIMIT


def near(reference: Cameras, targets: Cameras, degrees: float) -> Bool[Tensor, " view"]:
    """Which targets [view] look in the reference's direction, up to an angle between the optical axes."""
    axis, axes = reference.world_to_camera[2, :3], targets.world_to_camera[:, 2, :3]
    return axes @ axis >= math.cos(math.radians(degrees))
