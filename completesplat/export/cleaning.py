"""Preparation of Gaussians for files: removal of broken ones, and enlargement by the rasterizer's blur."""

import logging
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from completesplat.errors import PlyError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.rasterizers import RenderingConstants

# Renderers square scales and positions in float32.
LARGEST = 1e18

log = logging.getLogger(__name__)


def bounded(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Return a mask of Gaussians with finite values of at most 1e18."""
    limited = {name: values.where(values.abs() <= LARGEST, torch.inf) for name, values in vars(gaussians).items()}
    return replace(gaussians, **limited).finite()


def storable(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Return a mask of `bounded` Gaussians with extents above 0 (as float32) along all axes."""
    return bounded(gaussians) & (gaussians.scales.float() > 0).all(-1)


def cleaned(gaussians: Gaussians, name: object, usable: Callable[[Gaussians], Tensor] = storable) -> Gaussians:
    """Return one unbatched set without the Gaussians that are not usable, and log their number as a warning.

    Raises:
        PlyError: no Gaussian of a nonempty set is usable. Messages name the file or sample, `name`.
    """
    mask = usable(gaussians)
    broken = gaussians.count - int(mask.sum())
    if not broken:
        return gaussians
    if broken == gaussians.count:
        raise PlyError(f"{name}: all {broken} Gaussians are broken (not finite, or no extent)")
    log.warning("%s: left out %d of %d Gaussians (not finite, or no extent)", name, broken, gaussians.count)
    return gaussians[mask]


def beyond_gamut(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Return a mask of the Gaussians with a colour below 0 or above 1."""
    return ((gaussians.colors < 0) | (gaussians.colors > 1)).any(-1)


def transparent(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Return a mask of the Gaussians whose opacity is 0 in 8 bits: a reader would get a logit of minus infinity.

    Rasterizers leave them out as well: the original one draws nothing below 1/255.
    """
    return gaussians.opacities * 255 < 0.51  # not 0.5, because logits in files are rounded to float32


def with_screen_space_dilation(gaussians: Gaussians, reference: Cameras) -> Gaussians:
    """Return Gaussians enlarged by the blur that a rasterizer adds in the reference view.

    A rasterizer adds `blur` px^2 to each projected covariance. Training relies on this at its own image size, and makes
    Gaussians far smaller than a pixel. In a larger image they would be dots with gaps between them. At depth z,
    `blur * (z / focal length)^2` is therefore added to the covariance in all directions, which preserves its axes.
    `reference` is the camera of the photo, unbatched, at the image size that the model was trained with.
    """
    depth = transform_points(reference.world_to_camera, gaussians.means)[:, 2]
    variance = RenderingConstants().blur * (depth / reference.intrinsics[0, 0]).square()
    return replace(gaussians, scales=(gaussians.scales.square() + variance[:, None]).sqrt())
