"""Gaussians for files: without those that are broken, and as large on the screen as training saw them."""

import logging
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.rasterizers import RenderingConstants

# Renderers square scales and positions, in float32.
LARGEST = 1e18

log = logging.getLogger(__name__)


def storable(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Which Gaussians have finite values (of at most 1e18) and extents above 0 (as float32) along all axes."""
    bounded = gaussians.map(lambda values: values.where(values.abs() <= LARGEST, torch.inf)).finite()
    return bounded & (gaussians.scales.float() > 0).all(-1)


def cleaned(gaussians: Gaussians, name: object) -> Gaussians:
    """One unbatched set without the Gaussians that cannot be stored; their number is logged as a warning.

    `CompleteSplatError`: nothing is left of a set that was not empty; `name` is that of the file or sample.
    """
    kept = storable(gaussians)
    broken = gaussians.count - int(kept.sum())
    if not broken:
        return gaussians
    if broken == gaussians.count:
        raise CompleteSplatError(f"{name}: all {broken} Gaussians are broken (not finite, or no extent)")
    log.warning("%s: left out %d of %d Gaussians (not finite, or no extent)", name, broken, gaussians.count)
    return gaussians.keep(kept)


def beyond_gamut(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Which Gaussians have a colour outside of 0 to 1."""
    return ((gaussians.colors < 0) | (gaussians.colors > 1)).any(-1)


def transparent(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Which Gaussians have an opacity that rounds to 0 of 255, and so a logit of minus infinity where it is read back.

    Rasterizers leave them out, too: the original one draws nothing below 1/255.
    """
    return gaussians.opacities * 255 < 0.51  # files of logits are off by a rounding of float32


def with_screen_space_dilation(gaussians: Gaussians, reference: Cameras) -> Gaussians:
    """Gaussians that are larger by the rasterizer's blur, as it is in the reference view.

    A rasterizer adds its `blur` px^2 to each projected covariance. Training counts on it at its own picture size, and
    makes Gaussians far smaller than a pixel; in a larger picture they would be dots with gaps between them. A Gaussian
    at depth z gets `blur * (z / focal length)^2` added to its covariance in all directions, which leaves its axes. The
    camera is the photograph's, unbatched, at the size that the model was trained at.
    """
    depth = transform_points(reference.world_to_camera, gaussians.means)[:, 2]
    variance = RenderingConstants().blur * (depth / reference.intrinsics[0, 0]).square()
    return replace(gaussians, scales=(gaussians.scales.square() + variance[:, None]).sqrt())
