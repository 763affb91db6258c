"""Degenerate Gaussians, as training produces them: they must not affect the others."""

from dataclasses import replace

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

from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers.tiled import TiledRasterizer


@pytest.mark.parametrize("kind", NEVER_DRAWN)
def test_a_gaussian_that_cannot_be_drawn_changes_nothing(kind: str) -> None:
    assert_changes_nothing(TiledRasterizer(), changed(NEVER_DRAWN[kind]))


@pytest.mark.parametrize("kind", DRAWN)
def test_an_extreme_gaussian_is_drawn_as_by_the_float64_reference(kind: str) -> None:
    assert_drawn_as_by_the_reference(TiledRasterizer(), kind)


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_draw(count: int) -> None:
    gaussians = replace(healthy(count), means=healthy(count).means - 100)
    images, gradients = draw(TiledRasterizer(), gaussians)
    assert images.shape == (1, 1, 5, *SIZE)
    assert all(gradients[name].shape == tensor.shape for name, tensor in vars(gaussians).items())
    assert not any(tensor.any() for tensor in (images, *gradients.values()))


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
