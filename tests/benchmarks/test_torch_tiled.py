"""The pure-torch opponent of the benchmark computes the same function: its speed would mean nothing otherwise."""

import pytest
import torch
from degenerate_gaussians import DRAWN, NEVER_DRAWN, assert_as_good_as_absent, changed, draw, healthy
from rasterizer_scenes import OTHER_CONSTANTS, assert_agrees, cotangents_for, render_with_gradients, scenes

from completesplat.benchmarks import torch_tiled
from completesplat.benchmarks.torch_tiled import TorchTiledRasterizer
from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer

SIZES = [(13, 17), (16, 16), (9, 23), (31, 6), (1, 40)]


@pytest.mark.parametrize("seed", range(10))
def test_images_and_gradients_agree_with_the_float64_reference(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # So few tiles at a time and so short rounds that small scenes take many of each.
    monkeypatch.setattr(torch_tiled, "CHUNK", 5)
    monkeypatch.setattr(torch_tiled, "ROUND", 6)
    constants = RenderingConstants() if seed % 2 else OTHER_CONSTANTS
    gaussians, cameras = scenes(seed, 2, 3, SIZES[seed % len(SIZES)], constants)
    assert_agrees(TorchTiledRasterizer(constants), constants, gaussians, cameras, seed, 2e-5, 2e-4)


def test_a_long_list_is_drawn_until_its_pixels_are_opaque() -> None:
    """Hundreds of faint Gaussians, a wall, and others behind it that no pixel sees."""
    generator = torch.Generator().manual_seed(0)
    faint, walls = 400, 3
    depths = torch.cat([torch.linspace(1, 3, faint), torch.tensor([4.0, 5.0, 6.0])])
    count = faint + walls
    gaussians = Gaussians(
        means=torch.cat([0.05 * torch.randn(count, 2, generator=generator), depths[:, None]], dim=-1)[None],
        quaternions=torch.randn(1, count, 4, generator=generator),
        scales=torch.tensor([0.2] * faint + [50.0] * walls)[None, :, None].repeat(1, 1, 3),
        opacities=torch.tensor([0.01] * faint + [0.99] * walls)[None],
        colors=torch.rand(1, count, 3, generator=generator),
    )
    intrinsics = torch.tensor([[20.0, 0, 6], [0, 20, 6], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], intrinsics[None, None], (12, 12))
    found, gradients = render_with_gradients(TorchTiledRasterizer(), gaussians, cameras, cotangents_for(cameras, 0))
    with torch.no_grad():
        exact = ReferenceRasterizer()(gaussians.to(torch.float64), cameras.to(torch.float64))
    assert (found.color - exact.color).abs().max() <= 2e-5
    assert gradients["colors"][0, : faint + 1].any(-1).all()
    assert not gradients["colors"][0, -1].any()


@pytest.mark.parametrize("kind", [kind for kind in NEVER_DRAWN if "end of float32" not in kind])
def test_a_gaussian_that_cannot_be_drawn_is_as_good_as_absent(kind: str) -> None:
    assert_as_good_as_absent(TorchTiledRasterizer(), changed(NEVER_DRAWN[kind]), 1e-5)


@pytest.mark.parametrize("kind", ["zero quaternion", "scale zero", "needle", "opaque and large", "opacity above one"])
def test_an_extreme_gaussian_is_drawn_as_by_the_float64_reference(kind: str) -> None:
    gaussians = concatenate([changed(DRAWN[kind]), healthy(12)])
    found, gradients = draw(TorchTiledRasterizer(), gaussians)
    exact, _ = draw(ReferenceRasterizer(), gaussians.to(torch.float64))
    assert (found[:, :, :3] - exact[:, :, :3]).abs().max() <= 2e-5
    assert all(gradient.isfinite().all() for gradient in gradients.values())


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_draw(count: int) -> None:
    gaussians, cameras = scenes(3, 2, 2, (7, 11), RenderingConstants(), count=3)
    gaussians = gaussians.map(lambda tensor: tensor[:, :count])
    behind = Gaussians(**vars(gaussians) | {"opacities": torch.zeros_like(gaussians.opacities)})
    found, gradients = render_with_gradients(TorchTiledRasterizer(), behind, cameras, cotangents_for(cameras, 3))
    assert found.color.shape == (2, 2, 3, 7, 11)
    assert not any(image.any() for image in (found.color, found.depth, found.alpha))
    assert [gradients[name].shape for name in vars(gaussians)] == [tensor.shape for tensor in vars(gaussians).values()]
    assert not any(gradient.any() for gradient in gradients.values())
