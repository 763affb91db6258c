"""gsplat's torch implementation, on stand-ins for its CUDA parts, draws what the reference draws."""

import sys
from dataclasses import replace

import pytest
from rasterizer_scenes import OTHER_CONSTANTS, assert_agrees, scenes

from completesplat.benchmarks import gsplat_torch
from completesplat.benchmarks.gsplat_torch import GsplatTorchRasterizer
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers import RenderingConstants


@pytest.mark.parametrize(("seed", "size"), [(0, (13, 17)), (1, (40, 36)), (2, (9, 23))])
def test_images_and_gradients_agree_with_the_float64_reference(seed: int, size, monkeypatch) -> None:
    constants = RenderingConstants() if seed else replace(OTHER_CONSTANTS, frustum_margin=0.3)
    pytest.importorskip("gsplat")
    monkeypatch.setattr(gsplat_torch, "BUDGET", 2**14)  # so that a small scene takes several chunks
    gaussians, cameras = scenes(seed, 2, 3, size, constants)
    of = tuple(vars(gaussians))
    assert_agrees(GsplatTorchRasterizer(constants), constants, gaussians, cameras, seed, 1e-4, 1e-3, of)


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gsplat")
    with pytest.raises(CompleteSplatError, match="frustum_margin"):
        GsplatTorchRasterizer(OTHER_CONSTANTS)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setitem(sys.modules, "gsplat.cuda", None)
    with pytest.raises(CompleteSplatError, match="pip install gsplat"):
        GsplatTorchRasterizer()
