"""Workloads of the rasterizers: scenes like splatter images, and the time and memory of one rendering."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole, pixel_centers, unproject
from completesplat.rasterizers import Rasterizer
from completesplat.training.scoring import synchronized_time
from completesplat.training.steps import DISTANCE, FOV_DEGREES, cameras_on_orbit

OPACITIES = ("trained", "initial")
MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel; the reference takes a second for a tenth of them


class Backend(NamedTuple):
    """A rasterizer, its name in the tables, and the device of its tensors."""

    name: str
    rasterizer: Rasterizer

    @property
    def device(self) -> torch.device:
        return torch.device("cuda" if self.name == "cuda" else "cpu")

    def takes(self, gaussians: int, pixels: int) -> bool:
        """Return whether a workload with this many pixels in all views is feasible."""
        return self.name != "reference" or gaussians * pixels <= MOST_REFERENCE_PAIRS


def splatter_scene(size: int, views: int, opacity: str) -> tuple[Gaussians, Cameras]:
    """Return a scene (batch of 1) with two layers of one Gaussian per pixel, and cameras on an orbit about it.

    Opacities are as after training ("trained": a dense object, where pixels are soon opaque, before a thin background)
    or as at its start ("initial": all low, so that every Gaussian counts).
    """
    generator = torch.Generator().manual_seed(0)
    source = Cameras(torch.eye(4), pinhole(FOV_DEGREES, size), (size, size))
    layers = [_layer(layer, source, opacity, generator) for layer in range(2)]
    return merge_gaussians(layers)[None], cameras_on_orbit(size, views)


def _layer(layer: int, source: Cameras, opacity: str, generator: torch.Generator) -> Gaussians:
    """Return the front (0) or the back (1) of an ellipsoid, and a piece of background further away."""
    size = source.image_size[0]
    pixels = pixel_centers(size, size).flatten(0, 1)
    x, y = (pixels / size * 2 - 1).unbind(-1)
    radius = (x / 0.75).square() + (y / 0.8).square()
    bulge = 0.75 * (1 - radius).clamp(min=0).sqrt() * (1 if layer else -1)
    depth = DISTANCE + torch.where(radius < 1, bulge, 0.3 + 0.3 * layer)
    pixel_width = depth / source.intrinsics[0, 0]
    spread = 1.0 + layer if opacity == "trained" else 1.5  # standard deviation, in pixels
    noise = torch.randn(size * size, 9, generator=generator)
    uniform = torch.rand(size * size, generator=generator)
    trained = torch.where(radius < 1, (0.1 if layer else 0.55) + 0.44 * uniform, 0.02 + 0.3 * uniform**3)
    return Gaussians(
        means=unproject(source, pixels + 0.25 * noise[:, :2], depth),
        quaternions=torch.tensor([1.0, 0, 0, 0]) + 0.5 * noise[:, 2:6],
        scales=(spread * pixel_width)[:, None] * torch.exp(0.4 * noise[:, 6:]),
        opacities=trained if opacity == "trained" else 0.1 + 0.2 * uniform,
        colors=torch.stack([x, y, x * y], dim=-1).mul(3 + layer).sin() / 2 + 0.5,
    )


def rendering_milliseconds(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Return the times of the forward pass, and of both passes with gradients to all parameters of the Gaussians."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    ones = [_ones(cameras, channels) for channels in (3, 1, 1)]
    start = synchronized_time()
    rendering = rasterizer(gaussians, cameras)
    middle = synchronized_time()
    torch.autograd.backward([rendering.color, rendering.depth, rendering.alpha], ones)
    return (middle - start) * 1e3, (synchronized_time() - start) * 1e3


def _ones(cameras: Cameras, channels: int) -> Tensor:
    # NumPy, because torch would wake its own threads, which then spin for a while on the cores that are timed.
    ones = np.ones((*cameras.intrinsics.shape[:2], channels, *cameras.image_size), np.float32)
    return torch.from_numpy(ones).to(cameras.intrinsics.device)
