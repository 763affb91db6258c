"""Workloads of the rasterizers: scenes like splatter images, and the time and memory of one rendering."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from completesplat.benchmarks.measuring import milliseconds
from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras, pinhole, pixel_centers, unproject
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.kernels.array_layout import BLOCK
from completesplat.rasterizers.kernels.drawing import Drawing, Parameters
from completesplat.rasterizers.tiled import pack_cameras
from completesplat.training.stage import now
from completesplat.training.steps import DISTANCE, FOV_DEGREES, orbit

OPACITIES = ("trained", "initial")
MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel; the reference takes a second for a tenth of them
# Work of `tiled`'s kernels for both passes, counted in their sources. A sum, product, quotient or root is a FLOP.
PIXEL_FLOPS = 26 + 50  # of a Gaussian at a pixel: forward and backward, in float32
VISIBLE_FLOPS, REACHED_FLOPS = 2 * 136, 2 * 352  # projection and its gradient; in float64, which counts twice
# Bytes of arrays over Gaussians, which exceed the caches if there are many; images stay in a cache. For each Gaussian:
SCENE_BYTES = 2 * 56 + 68 + 32  # its parameters read and gradients written, `prepared` written, shape and opacity read
VIEW_BYTES = 68  # `prepared` read
BAND_BYTES = 4 + 4  # a place written and read
VISIBLE_BYTES = 5 * 64 + 128  # its record written, moved and read twice; its depth sorted
REACHED_BYTES = 2 * 64 + 4 + 48  # its row of gradients written and read, its place written, mean and root read
PEAK_SIDE, PEAK_COPY = 1536, 2**25  # of a matrix, and floats


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
    return concatenate(layers)[None], orbit(size, views)


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
    start = now()
    rendering = rasterizer(gaussians, cameras)
    middle = now()
    torch.autograd.backward([rendering.color, rendering.depth, rendering.alpha], ones)
    return (middle - start) * 1e3, (now() - start) * 1e3


def counted_work(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants) -> tuple[int, int]:
    """Return the FLOPs and the bytes that `tiled` takes for both passes."""
    parameters = Parameters(*(tensor.contiguous().numpy() for tensor in vars(gaussians).values()))
    packed = pack_cameras(cameras, constants.frustum_margin)
    drawing = Drawing(parameters, packed, cameras.image_size, constants, keep=True)
    drawing.draw()
    scenes, views = packed.shape[:2]
    drawn, reached = (int(count) for count in drawing.counts.sum(0))
    visible = int(drawing.visible_counts.sum())
    flops = PIXEL_FLOPS * BLOCK**2 * drawn + VISIBLE_FLOPS * visible + REACHED_FLOPS * reached
    one_view = VIEW_BYTES + BAND_BYTES * len(drawing.bands)
    everywhere = scenes * gaussians.count * (SCENE_BYTES + views * one_view)
    return flops, everywhere + VISIBLE_BYTES * visible + REACHED_BYTES * reached


def machine_peaks() -> tuple[float, float]:
    """Return the float32 FLOPs of a matrix product and the bytes of a copy (read and written) in a ms."""
    matrix, floats = torch.ones(PEAK_SIDE, PEAK_SIDE), torch.ones(PEAK_COPY)
    product, copy = torch.empty_like(matrix), torch.empty_like(floats)
    flops = 2 * PEAK_SIDE**3 / min(milliseconds(lambda: torch.mm(matrix, matrix, out=product)) for _ in range(5))
    return flops, 2 * 4 * PEAK_COPY / min(milliseconds(lambda: copy.copy_(floats)) for _ in range(5))


def _ones(cameras: Cameras, channels: int) -> Tensor:
    # NumPy, because torch would wake its own threads, which then spin for a while on the cores that are timed.
    ones = np.ones((*cameras.intrinsics.shape[:2], channels, *cameras.image_size), np.float32)
    return torch.from_numpy(ones).to(cameras.intrinsics.device)
