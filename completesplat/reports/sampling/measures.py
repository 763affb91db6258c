"""How faithful samples are to what is known."""

import math
from collections.abc import Mapping, Sequence

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
    return _cosines(reference, targets) >= math.cos(math.radians(degrees))


def farthest(reference: Cameras, targets: Cameras) -> int:
    """Which of the targets [view] looks in the direction most different from the reference's."""
    return int(_cosines(reference, targets).argmin())


def _cosines(reference: Cameras, targets: Cameras) -> Float[Tensor, " view"]:
    """Of the angles between the optical axes."""
    return targets.world_to_camera[:, 2, :3] @ reference.world_to_camera[2, :3]


def mean_over_scenes(measured: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """The mean of each figure, over the scenes that have it; None if none has."""
    means: dict[str, float | None] = {}
    for key in measured[0]:
        values = [value for row in measured if (value := row[key]) is not None]
        means[key] = sum(values) / len(values) if values else None
    return means
