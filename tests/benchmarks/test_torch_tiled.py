"""The pure-torch opponent of the benchmark computes the same function: its speed would mean nothing otherwise."""

from dataclasses import replace

import pytest
import torch
from degenerate_gaussians import DRAWN, NEVER_DRAWN, SIZE, assert_as_good_as_absent, changed, draw, healthy
from rasterizer_scenes import OTHER_CONSTANTS, assert_agrees, scenes

from completesplat.benchmarks import torch_tiled
from completesplat.benchmarks.torch_tiled import TorchTiledRasterizer
from completesplat.gaussians import concatenate
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
    gaussians = healthy(3).map(lambda tensor: tensor[:, :count])
    images, gradients = draw(TorchTiledRasterizer(), replace(gaussians, opacities=0 * gaussians.opacities))
    assert images.shape == (1, 1, 5, *SIZE)
    assert [gradients[name].shape for name in vars(gaussians)] == [tensor.shape for tensor in vars(gaussians).values()]
    assert not any(tensor.any() for tensor in (images, *gradients.values()))
