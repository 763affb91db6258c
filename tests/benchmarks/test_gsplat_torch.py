"""gsplat's torch implementation, on stand-ins for its CUDA parts, draws what the reference draws."""

import sys
from dataclasses import replace

import pytest
import torch
from rasterizer_scenes import OTHER_CONSTANTS, assert_agrees, cotangents_for, render_with_gradients, scenes

from completesplat.benchmarks import gsplat_torch
from completesplat.benchmarks.gsplat_torch import GsplatTorchRasterizer, intersect_tiles, weights_along_rays
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers import RenderingConstants


@pytest.mark.parametrize(("seed", "size"), [(0, (13, 17)), (1, (40, 36)), (2, (9, 23))])
def test_images_and_gradients_agree_with_the_float64_reference(
    seed: int, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    constants = RenderingConstants() if seed else replace(OTHER_CONSTANTS, frustum_margin=0.3)
    pytest.importorskip("gsplat")
    monkeypatch.setattr(gsplat_torch, "BUDGET", 2**14)  # so that a small scene takes several chunks
    gaussians, cameras = scenes(seed, 2, 3, size, constants)
    assert_agrees(
        GsplatTorchRasterizer(constants), constants, gaussians, cameras, seed, 1e-4, 1e-3, tuple(vars(gaussians))
    )


def test_nothing_to_draw() -> None:
    pytest.importorskip("gsplat")
    gaussians, cameras = scenes(3, 1, 2, (7, 11), RenderingConstants(), count=3)
    found, gradients = render_with_gradients(
        GsplatTorchRasterizer(),
        gaussians.map(lambda tensor: tensor - 100 if tensor.shape == gaussians.means.shape else tensor),
        cameras,
        cotangents_for(cameras, 3),
    )
    assert not found.color.any()
    assert not found.alpha.any()
    assert not any(gradient.any() for gradient in gradients.values())


def test_the_lists_of_tiles_are_those_of_gsplat() -> None:
    pytest.importorskip("gsplat")
    size, views, count = (40, 36), 3, 60
    gaussians, cameras = scenes(4, 1, views, size, RenderingConstants(), count=count)
    rasterizer = GsplatTorchRasterizer()
    splats = rasterizer._project(gaussians[0], cameras[0])
    keys, listed = intersect_tiles(splats, (5, 5), views)
    shaped = [tensor.unflatten(0, (views, count)) for tensor in (splats.centers, splats.radii, splats.depths)]
    _, expected_keys, expected = rasterizer.gsplat._isect_tiles(*shaped, gsplat_torch.TILE_SIZE, 5, 5)
    assert keys.numel() > views * count
    assert torch.equal(keys, expected_keys)
    assert torch.equal(listed, expected.long())


def test_weights_along_rays_are_those_of_each_ray_alone() -> None:
    alphas = torch.rand(50, generator=torch.Generator().manual_seed(0)) * 0.99
    pixels = torch.tensor([3] * 20 + [1] + [7] * 29)
    expected = []
    for part in alphas.split([20, 1, 29]):
        transmittance = 1.0
        for alpha in part.tolist():
            expected.append(alpha * transmittance)
            transmittance *= 1 - alpha
    assert torch.allclose(weights_along_rays(alphas, pixels), torch.tensor(expected), rtol=1e-5, atol=1e-30)


def test_a_frustum_margin_that_gsplat_does_not_have_is_refused() -> None:
    pytest.importorskip("gsplat")
    with pytest.raises(CompleteSplatError, match="frustum_margin"):
        GsplatTorchRasterizer(OTHER_CONSTANTS)


def test_without_gsplat_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setitem(sys.modules, "gsplat.cuda", None)
    with pytest.raises(CompleteSplatError, match="pip install gsplat"):
        GsplatTorchRasterizer()
