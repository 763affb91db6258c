"""Degenerate Gaussians, as training produces them, and a healthy scene around them."""

import math
from functools import partial

import torch
from rasterizer_scenes import cotangents_for, render_with_gradients
from torch import Tensor

from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.reference import ReferenceRasterizer

NAN, INF = math.nan, math.inf
SIZE = (14, 18)

# Changes to a healthy Gaussian at the centre of the view, 2 units away.
NEVER_DRAWN = {
    "behind the camera": {"means": (0.0, 0.0, -2.0)},
    "in the camera": {"means": (0.0, 0.0, 0.0)},
    "on the near plane": {"means": (0.0, 0.0, 0.01)},
    "far to the side": {"means": (1e30, 0.0, 2.0)},
    "beyond the end of float32 for the camera": {"means": (-3e38, 3e38, 3.4e38)},
    "mean nan": {"means": (0.0, NAN, 2.0)},
    "quaternion inf": {"quaternions": (INF, 0.0, 0.0, 1.0)},
    "scale nan": {"scales": (0.1, NAN, 0.1)},
    "scale inf": {"scales": (0.1, 0.1, INF)},
    "colour nan": {"colors": (NAN, 0.1, 0.1)},
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
    "long quaternion": {"quaternions": (1e25, -1e25, 2e25, 0.0)},
    "scale zero": {"scales": (0.0, 0.0, 0.0)},
    "one scale zero": {"scales": (0.2, 0.0, 0.1)},
    "scale negative": {"scales": (-0.2, 0.3, 0.1)},
    "needle": {"scales": (1e3, 1e-3, 1e-3)},
    "scale huge": {"scales": (1e6, 1e6, 1e6)},
    "opacity one": {"opacities": 1.0},
    "opacity above one": {"opacities": 1.5},
    "opaque and large": {"opacities": 1.0, "scales": (50.0, 50.0, 50.0)},
    "just before the near plane": {"means": (0.0, 0.0, 0.0101), "scales": (1e-3, 2e-3, 1e-3)},
    "before the near plane, to the side": {"means": (0.04, 0.0, 0.0101), "scales": (3e-2, 1e-2, 2e-2)},
    "very far": {"means": (0.0, 0.0, 1e30)},
}


def healthy(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(count)
    means = torch.randn(1, count, 3, generator=generator) * 0.3 + torch.tensor([0.03, -0.02, 2.0])
    quaternions = torch.randn(1, count, 4, generator=generator)
    scales = 0.05 + 0.2 * torch.rand(1, count, 3, generator=generator)
    opacities = 0.1 + 0.8 * torch.rand(1, count, generator=generator)
    return Gaussians(means, quaternions, scales, opacities, torch.rand(1, count, 3, generator=generator))


def changed(values: dict) -> Gaussians:
    gaussian = Gaussians(
        means=torch.tensor([[[0.03, -0.02, 2.0]]]),
        quaternions=torch.tensor([[[0.9, 0.3, -0.2, 0.1]]]),
        scales=torch.tensor([[[0.2, 0.3, 0.1]]]),
        opacities=torch.tensor([[0.7]]),
        colors=torch.tensor([[[0.2, 0.5, 0.8]]]),
    )
    changes = {name: torch.tensor(value).expand_as(getattr(gaussian, name)) for name, value in values.items()}
    fields = vars(gaussian) | changes
    return Gaussians(**{name: tensor.clone() for name, tensor in fields.items()})


def camera() -> Cameras:
    return Cameras(torch.eye(4)[None, None], pinhole(50.0, SIZE[1])[None, None], SIZE)


def draw(
    rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras | None = None, followed: tuple[str, ...] = ()
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return all images in one tensor, and gradients of the Gaussians (and of `followed`) under random cotangents."""
    cameras = (camera() if cameras is None else cameras).to(gaussians.means)
    cotangents = [cotangent.to(gaussians.means) for cotangent in cotangents_for(cameras, 1)]
    rendering, gradients = render_with_gradients(rasterizer, gaussians, cameras, cotangents, followed)
    return torch.cat(list(vars(rendering).values()), dim=2), gradients


def assert_changes_nothing(
    rasterizer: Rasterizer, gaussian: Gaussians, gradients_agree: float = 0.0, followed: tuple[str, ...] = ()
) -> None:
    rest = healthy(12).to(gaussian.means)
    expected, expected_gradients = draw(rasterizer, rest, followed=followed)
    images, gradients = draw(rasterizer, merge_gaussians([gaussian, rest]), followed=followed)
    assert expected.any()
    assert torch.equal(images, expected)
    for name, without in expected_gradients.items():
        gradient = gradients[name]
        if name in vars(gaussian):
            assert not gradient[:, 0].any(), name
            gradient = gradient[:, 1:]
        assert (gradient - without).norm() <= gradients_agree * without.norm(), name


def assert_drawn_as_by_the_reference(rasterizer: Rasterizer, kind: str, followed: tuple[str, ...] = ()) -> None:
    gaussians, of = merge_gaussians([healthy(12), changed(DRAWN[kind])]), partial(draw, followed=followed)
    images, gradients = of(rasterizer, gaussians)
    expected, expected_gradients = of(ReferenceRasterizer(), gaussians.to(torch.float64))
    assert not torch.equal(images, of(rasterizer, healthy(12))[0])
    assert ((images - expected).abs() <= 1e-5 * expected.abs().clamp(min=1)).all()
    for name, exact in expected_gradients.items():
        assert gradients[name].isfinite().all()
        parts = [(gradients[name], exact)]
        if name in vars(gaussians):
            parts = list(zip(*(x.split([12, 1], dim=1) for x in (gradients[name], exact)), strict=True))
        if (kind, name) == ("scale huge", "quaternions"):  # the rotation of a ball changes nothing
            assert parts.pop()[0].norm() <= 1e-4
        for actual, expected_part in parts:
            assert (actual - expected_part).norm() <= 2e-4 * expected_part.norm(), name
