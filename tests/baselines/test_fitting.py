"""Fitting finds what was rendered: scenes of known Gaussians, on a few pixels."""

import pytest
import torch

from completesplat.baselines.fitting import FittingSettings, fit_gaussians, initial_gaussians
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project
from completesplat.losses import WeightedSum
from completesplat.losses.terms import MeanSquaredError
from completesplat.metrics.images import psnr
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import Views

SIZE = 16
VIEWS = 6
DEPTH_RANGE = torch.tensor([[1.5, 2.5], [1.0, 3.0]])
FEW = FittingSettings(count=100, steps=40, views=2, position_rate=30.0, other_rates=10.0)
MSE = WeightedSum({"mse": {"weight": 1.0, "term": MeanSquaredError()}})


def render(gaussians: Gaussians, cameras: Cameras) -> torch.Tensor:
    return ReferenceRasterizer()(gaussians, cameras).over(0.5)


def fit(views: Views, seed: int, settings: FittingSettings = FEW) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return fit_gaussians(views, DEPTH_RANGE, ReferenceRasterizer(), 0.5, MSE, settings, generator)


@pytest.fixture(scope="module")
def views() -> Views:
    """Two scenes of twenty opaque blobs each, from cameras on an arc at a distance of 2."""
    generator = torch.Generator().manual_seed(0)
    angles = torch.linspace(-0.6, 0.6, VIEWS)
    eyes = 2 * torch.stack([angles.sin(), torch.zeros(VIEWS), -angles.cos()], dim=-1)
    matrices = look_at(eyes, torch.zeros(3), torch.tensor([0.0, -1, 0])).expand(2, VIEWS, 4, 4)
    cameras = Cameras(matrices, pinhole(40.0, SIZE).expand(2, VIEWS, 3, 3), (SIZE, SIZE))
    blobs = Gaussians(
        means=torch.rand(2, 20, 3, generator=generator) - 0.5,
        quaternions=torch.randn(2, 20, 4, generator=generator),
        scales=0.05 + 0.1 * torch.rand(2, 20, 3, generator=generator),
        opacities=torch.full((2, 20), 0.9),
        colors=torch.rand(2, 20, 3, generator=generator),
    )
    return Views(render(blobs, cameras), cameras, torch.ones(2, VIEWS, 1, SIZE, SIZE))


def quality(gaussians: Gaussians, views: Views) -> float:
    return psnr(render(gaussians, views.cameras).flatten(0, 1), views.images.flatten(0, 1)).mean().item()


def test_a_known_scene_is_found_again(views):
    start = quality(fit(views, 0, FittingSettings(count=100, steps=0)), views)
    assert start < 20
    assert quality(fit(views, 0), views) > start + 10


def test_the_seed_decides_everything_where_autograd_is_off_too(views):
    settings = FittingSettings(count=50, steps=5)
    one, again, other = (fit(views, seed, settings) for seed in (0, 0, 1))
    torch.testing.assert_close(vars(one), vars(again), atol=0, rtol=0)
    assert not torch.equal(one.means, other.means)
    with torch.inference_mode():
        result = fit(views.map(torch.clone), 0, settings)
    assert torch.equal(result.means, one.means)
    assert not result.means.requires_grad


def test_the_start_lies_on_rays_of_pixels_and_has_their_colors(views):
    one = Views(views.images[:, :1], views.cameras[:, :1], views.masks[:, :1])
    gaussians = initial_gaussians(one, DEPTH_RANGE, 300, 0.1, torch.Generator().manual_seed(0)).gaussians()
    pixels, depths = project(one.cameras[:, 0], gaussians.means)
    torch.testing.assert_close(pixels, pixels.floor() + 0.5, atol=1e-3, rtol=0)
    assert (depths > DEPTH_RANGE[:, :1] - 1e-4).all()
    assert (depths < DEPTH_RANGE[:, 1:] + 1e-4).all()
    assert (depths.amax(1) - depths.amin(1) > 0.9 * DEPTH_RANGE.diff(dim=1)[:, 0]).all()
    for b in range(2):
        column, row = pixels[b].long().unbind(-1)
        torch.testing.assert_close(gaussians.colors[b], one.images[b, 0, :, row, column].mT, atol=1e-5, rtol=0)
    # The standard deviation covers one pixel at that depth.
    focal = one.cameras.intrinsics[:, 0, 0, 0]
    torch.testing.assert_close(gaussians.scales[..., 0] * focal[:, None] / depths, torch.ones(2, 300))
    torch.testing.assert_close(gaussians.opacities, torch.full((2, 300), 0.1))
