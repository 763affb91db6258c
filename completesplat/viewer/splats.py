"""Gaussians as what viser draws: covariances and bytes."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.export.depth_colors import color_depth
from completesplat.gaussians import Gaussians

LARGEST_COVARIANCE = 3e4


class Splats(NamedTuple):
    """What `add_gaussian_splats` takes, in units of `scale` scene units.

    viser keeps covariances as float16, which ends at 65504 and has few digits below 6e-5: the unit is chosen so that
    the largest one is just below that end, and thin Gaussians keep their shape.
    """

    centers: Float[np.ndarray, "gaussian 3"]
    covariances: Float[np.ndarray, "gaussian 3 3"]
    colors: UInt8[np.ndarray, "gaussian 3"]
    opacities: UInt8[np.ndarray, "gaussian 1"]
    scale: float


def to_splats(gaussians: Gaussians) -> Splats:
    """One unbatched set. Gaussians that are not finite are left out, and colours above 1 become 1."""
    kept = gaussians.keep(gaussians.finite()).to("cpu")
    largest = kept.scales.max().item() if kept.count else 1.0
    scale = max(largest, 1e-12) / math.sqrt(LARGEST_COVARIANCE)
    unit = replace(kept, means=kept.means / scale, scales=kept.scales / scale)
    return Splats(
        unit.means.float().numpy(),
        unit.covariances().float().numpy(),
        _bytes(kept.colors),
        _bytes(kept.opacities[:, None]),
        scale,
    )


def layer_of(gaussians: Gaussians, layer: int, layers: int) -> Gaussians:
    """One layer of a splatter image's Gaussians, which are ordered by layer, row, column."""
    size = gaussians.count // layers
    return gaussians[layer * size : (layer + 1) * size]


def depth_colored(scenes: Sequence[Gaussians]) -> list[Gaussians]:
    """The scenes in the colours of their depths (z), near bright and far dark, on one scale for all of them."""
    depths = torch.cat([scene.means[:, 2] for scene in scenes])
    colors, _ = color_depth(depths[None, None, :])
    parts = colors[:, 0].T.split([scene.count for scene in scenes])
    return [replace(scene, colors=part) for scene, part in zip(scenes, parts, strict=True)]


def _bytes(values: Float[Tensor, "gaussian channel"]) -> UInt8[np.ndarray, "gaussian channel"]:
    return values.detach().clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
