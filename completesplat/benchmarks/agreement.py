"""Differences between the rasterizers' images of a large scene and the float64 reference."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from completesplat.benchmarks.workloads import Backend
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import (
    ReferenceRasterizer,
    alphas_at,
    project_gaussians,
    visible_in_depth_order,
)

# `tiled` projects and sorts in float64, like the reference. The others use float32, so that some neighbours in depth
# change places in a large scene.
TOLERANCE, FLOAT32_TOLERANCE = {"tiled": 1e-5}, 1e-4
PIXELS_PER_VIEW, PIXELS_AT_ONCE = 128, 8
# If the relative distance of an alpha to its threshold, or of a transmittance to its stop, is below these, float32 may
# rightly decide differently from float64. These pixels are counted, but not compared.
BAND, STOP_BAND = 1e-4, 1e-3


def agreement_rows(
    backends: Sequence[Backend], gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants,
    tick: Callable[[str], None],
) -> list[dict[str, Any]]:  # fmt: skip
    """Return each backend's largest errors over sampled pixels of all views of one scene (batch of 1).

    Errors of `color` and `alpha` are absolute, that of `depth` is relative to the largest depth of the sampled pixels.
    `pixels` were compared, `undecided` were left out. `agrees` is whether all three errors are within the backend's
    tolerance. An error that is not finite becomes None, and does not agree.
    """
    scene, seen = gaussians[0].to(torch.float64), cameras[0].to(torch.float64)
    views, (height, width) = len(seen.intrinsics), cameras.image_size
    generator = torch.Generator().manual_seed(0)
    positions = torch.randint(height * width, (views, PIXELS_PER_VIEW), generator=generator)
    exact, decided = [], []
    for view in range(views):
        tick(f"reference at {PIXELS_PER_VIEW} pixels of view {view}")
        pixels = (torch.stack([positions[view] % width, positions[view] // width], dim=-1) + 0.5).double()
        exact.append(ReferenceRasterizer(constants).at_pixels(scene, seen[view], pixels))
        decided.append(is_decided(scene, seen[view], pixels, constants))
    expected, mask = torch.stack(exact), torch.stack(decided)
    scale = torch.ones(5).index_fill(0, torch.tensor(3), expected[..., 3].max().item() or 1.0)
    result = []
    for backend in backends:
        if backend.name == "reference":
            continue
        tick(backend.name)
        errors = ((draw_at(backend, gaussians, cameras, positions) - expected).abs() / scale)[mask]
        largest = errors.amax(0) if len(errors) else torch.full((5,), torch.nan)
        figures = {"color": largest[:3].max().item(), "depth": largest[3].item(), "alpha": largest[4].item()}
        agrees = bool((largest <= TOLERANCE.get(backend.name, FLOAT32_TOLERANCE)).all())
        counts = {"pixels": int(mask.sum()), "undecided": int((~mask).sum())}
        finite = {name: error if math.isfinite(error) else None for name, error in figures.items()}
        result.append({"backend": backend.name, **finite, "agrees": agrees, **counts})
    return result


@torch.no_grad()
def draw_at(
    backend: Backend, gaussians: Gaussians, cameras: Cameras, positions: Int[Tensor, "view pixel"]
) -> Float[Tensor, "view pixel 5"]:
    """Return red, green, blue, depth and alpha of one scene at row-major positions of each view's image."""
    rendering = backend.rasterizer(gaussians.to(backend.device), cameras.to(backend.device)).to("cpu")[0]
    images = torch.cat([rendering.color, rendering.depth, rendering.alpha], dim=1).flatten(-2)
    return images.gather(-1, positions[:, None].expand(-1, 5, -1)).mT


@torch.no_grad()
def is_decided(
    gaussians: Gaussians, camera: Cameras, pixels: Float[Tensor, "pixel 2"], constants: RenderingConstants
) -> Bool[Tensor, " pixel"]:
    """Return a mask of the pixels that are not close to a threshold, where no decision depends on rounding."""
    visible, order = visible_in_depth_order(gaussians, camera, constants)
    chosen = gaussians[visible][order]
    centers, _, covariances = project_gaussians(chosen, camera, constants)
    marks = []
    for chunk in torch.split(pixels, PIXELS_AT_ONCE):
        alphas = alphas_at(chunk, centers, covariances, chosen.opacities, replace(constants, min_alpha=0.0))
        drawn = torch.where(alphas >= constants.min_alpha, alphas, 0)
        behind = torch.cumprod(1 - drawn, dim=0)
        steps = (alphas / constants.min_alpha - 1).abs() < BAND
        steps |= (behind / constants.min_transmittance - 1).abs() < STOP_BAND
        marks.append(~steps.any(0))
    return torch.cat(marks)
