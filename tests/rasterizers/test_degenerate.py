"""Degenerate Gaussians: images and gradients stay finite, and the healthy Gaussians do not change."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from degenerate_gaussians import (
    DRAWN,
    NEVER_DRAWN,
    SIZE,
    assert_changes_nothing,
    assert_drawn_as_by_the_reference,
    camera,
    changed,
    draw,
    healthy,
)
from rasterizer_scenes import CONSTANTS, assert_agrees
from torch import Tensor

from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer, alphas_at
from completesplat.rasterizers.tiled import TiledRasterizer

DTYPES = [torch.float32, torch.float64]
CAMERAS = ("world_to_camera", "intrinsics")
RASTERIZERS = [(ReferenceRasterizer(), torch.float32, CAMERAS), (ReferenceRasterizer(), torch.float64, CAMERAS)]
RASTERIZERS += [(TiledRasterizer(), torch.float32, ())]

LEFT_OUT = NEVER_DRAWN | {
    "on the camera's plane": {"means": (1.0, 0.5, 0.0)},
    "one scale whose square overflows": {"scales": (1e30, 0.1, 0.1), "quaternions": (1.0, 2.0, 3.0, 4.0)},
    "scale whose determinant overflows": {"scales": (1e12, 1e12, 1e12), "quaternions": (1.0, 2.0, 3.0, 4.0)},
}
EXTREME = DRAWN | {
    # Found by search: the determinant of its projection is lost to rounding in float32.
    "needle as long as the sky": {
        "means": (7.726273536682129, 0.7486287355422974, 0.6572197675704956),
        "quaternions": (-0.9036192297935486, 1.5352706909179688, -0.6311081051826477, -0.4898175895214081),
        "scales": (389714.34375, 0.00031615764601156116, 0.00031615764601156116),
    },
    "needle 1e-6": {"scales": (1e3, 1e-6, 1e-6)},
    "just beyond the near plane, far aside": {"means": (50.0, 0.0, 0.0101)},
    "very far in the corner": {"means": (1e30, 1e30, 1e30)},
}


def degenerate(changes: dict[str, object], dtype: torch.dtype) -> Gaussians:
    return changed(changes).to(dtype)


render_and_differentiate = partial(draw, ReferenceRasterizer(), followed=CAMERAS)


def assert_finite(image: Tensor, gradients: dict[str, Tensor]) -> None:
    assert image.isfinite().all()
    assert [name for name, gradient in gradients.items() if not gradient.isfinite().all()] == []


@pytest.mark.parametrize(("rasterizer", "dtype", "followed"), RASTERIZERS)
@pytest.mark.parametrize("kind", LEFT_OUT)
def test_a_gaussian_that_cannot_be_drawn_changes_nothing(kind: str, rasterizer, dtype: torch.dtype, followed) -> None:
    assert_changes_nothing(rasterizer, degenerate(LEFT_OUT[kind], dtype), followed=followed)


@pytest.mark.parametrize(("rasterizer", "dtype", "followed"), RASTERIZERS)
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_draw(count: int, rasterizer, dtype: torch.dtype, followed) -> None:
    gaussians = healthy(count).to(dtype)
    images, gradients = draw(rasterizer, replace(gaussians, means=gaussians.means - 100), followed=followed)
    assert images.shape == (1, 1, 5, *SIZE)
    assert all(gradients[name].shape == tensor.shape for name, tensor in vars(gaussians).items())
    assert not any(tensor.any() for tensor in (images, *gradients.values()))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", EXTREME)
def test_extreme_gaussians_are_drawn_with_finite_values_and_gradients(kind: str, dtype: torch.dtype) -> None:
    assert_finite(*render_and_differentiate(merge_gaussians([healthy(20).to(dtype), degenerate(EXTREME[kind], dtype)])))
    assert_finite(*render_and_differentiate(degenerate(EXTREME[kind], dtype)))


def test_the_sign_of_a_scale_and_a_zero_quaternion_have_a_meaning() -> None:
    """Only the squares of scales enter; a zero quaternion is the identity."""
    identity = {"quaternions": (1.0, 0.0, 0.0, 0.0)}
    image, _ = render_and_differentiate(degenerate(identity, torch.float64))
    assert image.any()
    negative, _ = render_and_differentiate(degenerate(identity | {"scales": (-0.2, 0.3, -0.1)}, torch.float64))
    zero, gradients = render_and_differentiate(degenerate({"quaternions": (0.0, 0.0, 0.0, 0.0)}, torch.float64))
    assert torch.equal(negative, image)
    assert torch.equal(zero, image)
    assert not gradients["quaternions"].any()


def test_nothing_is_drawn_where_rounding_makes_the_exponent_positive() -> None:
    """An indefinite matrix has directions in which its quadratic form is negative."""
    pixels = torch.tensor([[1.0, 1.0], [1.0, -1.0]])
    center = torch.zeros(1, 2)
    covariance = torch.tensor([[[1.0, 2.0], [2.0, 1.0]]])
    alphas = alphas_at(pixels, center, covariance, torch.tensor([0.5]), RenderingConstants())
    assert alphas[0, 0] == 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_many_gaussians_at_one_place(dtype: torch.dtype) -> None:
    """Equal depths keep their order, and a transmittance that underflows does no harm."""
    colors = [[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]]
    front, back = (degenerate({"colors": color, "opacities": 0.5}, dtype) for color in colors)
    image, _ = render_and_differentiate(merge_gaussians([front, back]))
    swapped, _ = render_and_differentiate(merge_gaussians([back, front]))
    assert image[0, 0, 0].max() < swapped[0, 0, 0].max()
    assert_finite(*render_and_differentiate(merge_gaussians([degenerate({"opacities": 1.0}, dtype)] * 400)))


@pytest.mark.parametrize("kind", DRAWN)
def test_an_extreme_gaussian_is_drawn_as_by_the_float64_reference(kind: str) -> None:
    assert_drawn_as_by_the_reference(TiledRasterizer(), kind)


def test_all_at_one_depth_keep_their_order() -> None:
    gaussians = healthy(12)
    gaussians.means[..., 2] = 2.0
    assert_agrees(TiledRasterizer(), CONSTANTS, gaussians, camera(), 1)
    (there, _), (back, _) = (draw(TiledRasterizer(), g) for g in (gaussians, gaussians.map(lambda t: t.flip(1))))
    assert not torch.allclose(there, back)


def test_thousands_of_gaussians_on_one_pixel() -> None:
    """All are faint, so that a pixel is opaque only after hundreds."""
    one = changed({"opacities": 0.01, "scales": (0.001, 0.001, 0.001), "means": (0.0, 0.0, 2.0)})
    many = one.map(lambda tensor: tensor.expand(1, 10_000, *tensor.shape[2:]).clone())
    many.colors[:] = torch.rand(many.colors.shape, generator=torch.Generator().manual_seed(0))
    cameras = Cameras(torch.eye(4)[None, None], torch.tensor([[[[2.0, 0, 1.5], [0, 2.0, 1.5], [0, 0, 1]]]]), (3, 3))
    assert_agrees(TiledRasterizer(), CONSTANTS, many, cameras, 1)
    images, gradients = draw(TiledRasterizer(), many, cameras)
    assert images[0, 0, 4, 1, 1] > 0.99
    assert gradients["opacities"].count_nonzero() > 500
    assert not gradients["opacities"][0, 5_000:].any()
