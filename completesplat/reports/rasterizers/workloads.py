"""Scenes of the size and structure of splatter images, for benchmarks: no network is needed to make them."""

import math

import torch
from torch import Tensor

from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras, look_at, pinhole, pixel_centers, unproject

DISTANCE = 2.2  # from the cameras to the object's centre, world units
FOV_DEGREES = 49.0
OPACITIES = ("trained", "initial")


def splatter_scene(size: int, views: int, opacity: str, image_size: int | None = None) -> tuple[Gaussians, Cameras]:
    """One scene (batch of 1) of two Gaussians to a pixel, in two layers, and cameras on an orbit about it.

    The opacities are as after training ("trained": a dense object, where pixels are soon opaque, in front of thin
    air) or as at its start ("initial": all low, so that every Gaussian counts). `size` is the side of the splatter
    image; what the cameras see has the side `image_size`, or the same.
    """
    generator = torch.Generator().manual_seed(0)
    source = Cameras(torch.eye(4), pinhole(FOV_DEGREES, size), (size, size))
    layers = [_layer(layer, source, opacity, generator) for layer in range(2)]
    return concatenate(layers)[None], orbit(image_size or size, views)


def _layer(layer: int, source: Cameras, opacity: str, generator: torch.Generator) -> Gaussians:
    """The front (0) or the back (1) of an ellipsoid, and a piece of background further away."""
    size = source.image_size[0]
    pixels = pixel_centers(size, size).flatten(0, 1)
    x, y = (pixels / size * 2 - 1).unbind(-1)
    radius = (x / 0.75).square() + (y / 0.8).square()
    bulge = 0.75 * (1 - radius).clamp(min=0).sqrt() * (1 if layer else -1)
    depth = DISTANCE + torch.where(radius < 1, bulge, 0.3 + 0.3 * layer)
    pixel_width = depth / source.intrinsics[0, 0]
    spread = 1.0 + layer if opacity == "trained" else 1.5  # standard deviation, in pixels
    noise = torch.randn(size * size, 9, generator=generator)
    return Gaussians(
        means=unproject(source, pixels + 0.25 * noise[:, :2], depth),
        quaternions=torch.tensor([1.0, 0, 0, 0]) + 0.5 * noise[:, 2:6],
        scales=(spread * pixel_width)[:, None] * torch.exp(0.4 * noise[:, 6:]),
        opacities=_opacities(layer, radius < 1, opacity, generator),
        colors=torch.stack([x, y, x * y], dim=-1).mul(3 + layer).sin() / 2 + 0.5,
    )


def _opacities(layer: int, inside: Tensor, opacity: str, generator: torch.Generator) -> Tensor:
    uniform = torch.rand(inside.shape, generator=generator)
    if opacity == "initial":
        return 0.1 + 0.2 * uniform
    return torch.where(inside, (0.1 if layer else 0.55) + 0.44 * uniform, 0.02 + 0.3 * uniform**3)


def orbit(size: int, views: int) -> Cameras:
    """Cameras [1 view] about the object, for images of this side."""
    angles = 0.5 + 2 * math.pi * torch.arange(views) / views
    target = torch.tensor([0.0, 0.0, DISTANCE])
    eyes = target + DISTANCE * torch.stack([angles.sin(), torch.full_like(angles, -0.2), -angles.cos()], dim=-1)
    matrices = look_at(eyes, target, torch.tensor([0.0, -1.0, 0.0]))
    return Cameras(matrices[None], pinhole(FOV_DEGREES, size).expand(1, views, 3, 3), (size, size))
