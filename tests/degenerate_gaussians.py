"""Gaussians that no rasterizer should meet, but that training produces, and a healthy scene for them to spoil."""

import math

import torch

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole

NAN, INF = math.nan, math.inf
SIZE = (14, 18)

# What is changed in a healthy Gaussian, at the centre of the view and 2 units away.
NEVER_DRAWN = {
    "behind the camera": {"means": (0.0, 0.0, -2.0)},
    "in the camera": {"means": (0.0, 0.0, 0.0)},
    "on the near plane": {"means": (0.0, 0.0, 0.01)},
    "far to the side": {"means": (1e30, 0.0, 2.0)},
    "at the end of float32": {"means": (3e38, 3e38, 3e38)},
    "beyond the end of float32 for the camera": {"means": (-3e38, 3e38, 3.4e38)},
    "mean nan": {"means": (0.0, NAN, 2.0)},
    "mean inf": {"means": (0.0, 0.0, INF)},
    "quaternion nan": {"quaternions": (NAN, 0.0, 0.0, 1.0)},
    "quaternion inf": {"quaternions": (INF, 0.0, 0.0, 1.0)},
    "scale nan": {"scales": (0.1, NAN, 0.1)},
    "scale inf": {"scales": (0.1, 0.1, INF)},
    "scale minus inf": {"scales": (-INF, 0.1, 0.1)},
    "colour nan": {"colors": (NAN, 0.1, 0.1)},
    "colour inf": {"colors": (0.1, 0.1, INF)},
    "scale enormous": {"scales": (1e14, 1e13, 1e14)},
    "scale at the end of float32": {"scales": (3e38, 1e-38, 3e38)},
    "opacity nan": {"opacities": NAN},
    "opacity inf": {"opacities": INF},
    "opacity zero": {"opacities": 0.0},
    "opacity negative": {"opacities": -0.5},
    "opacity below the threshold": {"opacities": 0.0039},
}
DRAWN = {
    "zero quaternion": {"quaternions": (0.0, 0.0, 0.0, 0.0)},
    "vanishing quaternion": {"quaternions": (1e-20, 1e-20, 0.0, 0.0)},
    "short quaternion": {"quaternions": (1e-10, -1e-10, 2e-10, 0.0)},
    "long quaternion": {"quaternions": (1e25, -1e25, 2e25, 0.0)},
    "scale zero": {"scales": (0.0, 0.0, 0.0)},
    "one scale zero": {"scales": (0.2, 0.0, 0.1)},
    "scale negative": {"scales": (-0.2, 0.3, 0.1)},
    "scale tiny": {"scales": (1e-30, 1e-38, 1e-20)},
    "needle": {"scales": (1e3, 1e-3, 1e-3)},
    "scale huge": {"scales": (1e6, 1e6, 1e6)},
    "opacity one": {"opacities": 1.0},
    "opacity above one": {"opacities": 1.5},
    "opaque and large": {"opacities": 1.0, "scales": (50.0, 50.0, 50.0)},
    "just before the near plane": {"means": (0.0, 0.0, 0.0101), "scales": (1e-3, 2e-3, 1e-3)},
    "before the near plane, to the side": {"means": (0.04, 0.0, 0.0101), "scales": (3e-2, 1e-2, 2e-2)},
    "very far": {"means": (0.0, 0.0, 1e30)},
}
# The rotation of a large ball changes nothing, so that its exact gradient is zero.
FLAT = ("scale huge",)


def healthy(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(count)
    means = torch.randn(1, count, 3, generator=generator) * 0.3 + torch.tensor([0.03, -0.02, 2.0])
    quaternions = torch.randn(1, count, 4, generator=generator)
    scales = 0.05 + 0.2 * torch.rand(1, count, 3, generator=generator)
    opacities = 0.1 + 0.8 * torch.rand(1, count, generator=generator)
    return Gaussians(means, quaternions, scales, opacities, torch.rand(1, count, 3, generator=generator))


def changed(values: dict) -> Gaussians:
    one = Gaussians(
        means=torch.tensor([[[0.03, -0.02, 2.0]]]),
        quaternions=torch.tensor([[[0.9, 0.3, -0.2, 0.1]]]),
        scales=torch.tensor([[[0.2, 0.3, 0.1]]]),
        opacities=torch.tensor([[0.7]]),
        colors=torch.tensor([[[0.2, 0.5, 0.8]]]),
    )
    fields = vars(one) | {name: torch.tensor(value).expand_as(getattr(one, name)) for name, value in values.items()}
    return Gaussians(**{name: tensor.clone() for name, tensor in fields.items()})


def camera() -> Cameras:
    return Cameras(torch.eye(4)[None, None], pinhole(50.0, SIZE[1])[None, None], SIZE)
