"""Comparison on a large scene: who agrees, and which pixels cannot tell."""

import json
import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from rasterizer_scenes import draw_scene

from completesplat.benchmarks.agreement import BAND, PIXELS_PER_VIEW, STOP_BAND, TOLERANCE, agreement_rows, is_decided
from completesplat.benchmarks.workloads import Backend
from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, Rendering, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer

CONSTANTS = RenderingConstants()
FOCAL, DEPTH, SCALE = 50.0, 2.0, 0.1


def compare(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> dict:
    (row,) = agreement_rows([Backend("tiled", rasterizer)], gaussians, cameras, CONSTANTS, lambda _: None)
    json.dumps(row, allow_nan=False)
    return row


def changed(change: Callable[[Rendering], Rendering]) -> Rasterizer:
    return lambda gaussians, cameras: change(TiledRasterizer()(gaussians, cameras))


@pytest.fixture(scope="module")
def random_scene() -> tuple[Gaussians, Cameras]:
    return draw_scene(torch.Generator().manual_seed(0), 1, 3, (30, 40), 300)


def test_tiled_agrees_with_the_reference(random_scene) -> None:
    row = compare(TiledRasterizer(), *random_scene)
    assert row["agrees"]
    assert all(0 < row[key] < 1e-5 for key in ("color", "depth", "alpha"))
    assert row["pixels"] + row["undecided"] == 3 * PIXELS_PER_VIEW
    assert row["pixels"] > 2 * PIXELS_PER_VIEW


@pytest.mark.parametrize("channel", [0, 1, 2, 3])
@pytest.mark.parametrize("error", [1e-3, math.nan])
def test_what_is_slightly_off_or_not_finite_does_not_agree(random_scene, channel: int, error: float) -> None:
    """An error of the depth is relative to the largest."""

    def spoil(images: Rendering) -> Rendering:
        if channel == 3:
            return replace(images, depth=(1 + error) * images.depth)
        return replace(images, color=images.color + error * torch.eye(3)[channel, :, None, None])

    row = compare(changed(spoil), *random_scene)
    assert row["agrees"] is False
    off = row.pop("depth" if channel == 3 else "color")
    assert off is None if math.isnan(error) else off == pytest.approx(error, rel=0.02)
    assert max(row.get("depth", 0), row.get("color", 0), row["alpha"]) < 1e-5


def test_alphas_that_are_slightly_off_agree_where_that_is_tolerated(random_scene, monkeypatch) -> None:
    rasterizer = changed(lambda images: replace(images, alpha=images.alpha - 5e-5))
    assert compare(rasterizer, *random_scene)["agrees"] is False
    monkeypatch.setitem(TOLERANCE, "tiled", 1e-4)
    assert compare(rasterizer, *random_scene)["agrees"] is True
    row = compare(changed(lambda images: replace(images, alpha=math.nan * images.alpha)), *random_scene)
    assert (row["agrees"], row["alpha"]) == (False, None)


def test_each_backend_has_its_row_but_for_the_reference(random_scene) -> None:
    backends, said = [Backend(name, ReferenceRasterizer()) for name in ("b", "reference", "a")], []
    found = agreement_rows(backends, *random_scene, CONSTANTS, said.append)
    assert [row["backend"] for row in found] == said[-2:] == ["b", "a"]


def straight_ahead(opacities: list[float], size: int, dtype: torch.dtype = torch.float64) -> tuple[Gaussians, Cameras]:
    """Round Gaussians [1 n], one behind another, before a camera [1 1] with its principal point at a pixel's centre."""
    count = len(opacities)
    means = torch.zeros(1, count, 3, dtype=dtype)
    means[..., 2] = DEPTH + 1e-3 * torch.arange(count)
    gaussians = Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0], dtype=dtype).expand(1, count, 4),
        torch.full((1, count, 3), SCALE, dtype=dtype),
        torch.tensor([opacities], dtype=dtype),
        torch.full((1, count, 3), 0.5, dtype=dtype),
    )
    center = size // 2 + 0.5
    intrinsics = torch.tensor([[FOCAL, 0, center], [0, FOCAL, center], [0, 0, 1]], dtype=dtype)
    return gaussians, Cameras(torch.eye(4, dtype=dtype)[None, None], intrinsics[None, None], (size, size))


def decided(gaussians: Gaussians, cameras: Cameras, distance: float = 0.0) -> bool:
    """Whether the pixel at this distance (px) from the principal point is."""
    pixel = cameras.intrinsics[0, :, :2, 2] + torch.tensor([[distance, 0.0]]).double()
    return bool(is_decided(gaussians[0], cameras[0, 0], pixel, CONSTANTS))


@pytest.mark.parametrize("ratio", [1, 1.00005, 0.99995, 1.001, 0.999, 50])
def test_a_pixel_is_undecided_where_an_alpha_is_at_the_threshold(ratio: float) -> None:
    """With alpha = opacity exp(-d^2 / 2 s^2), s^2 = (f scale / depth)^2 + blur, the distance d follows."""
    expected = abs(ratio - 1) > BAND
    variance = (FOCAL * SCALE / DEPTH) ** 2 + CONSTANTS.blur
    opacity = 0.5
    distance = math.sqrt(2 * variance * math.log(opacity / (ratio * CONSTANTS.min_alpha)))
    assert decided(*straight_ahead([opacity], 9), distance) is expected
    in_front, cameras = straight_ahead([0.3], 9)
    behind = straight_ahead([0.3, opacity], 9)[0][:, 1:]
    behind.means[..., 2] = DEPTH
    in_front.means[..., 2] = DEPTH / 2  # twice as wide, so that its own alpha is far from the threshold
    assert decided(concatenate([in_front, behind]), cameras, distance) is expected


@pytest.mark.parametrize("ratio", [1, 1.0005, 0.9995, 1.002, 0.998, 9])
def test_a_pixel_is_undecided_where_the_transmittance_is_at_the_stop(ratio: float) -> None:
    """Two Gaussians of this opacity leave (1 - opacity)^2 behind them; what comes third is of no importance."""
    expected = abs(ratio - 1) > STOP_BAND
    opacity = 1 - math.sqrt(ratio * CONSTANTS.min_transmittance)
    assert decided(*straight_ahead([opacity, opacity], 9)) is expected
    assert decided(*straight_ahead([opacity, opacity, 0.9], 9)) is expected


def test_what_is_too_faint_to_be_drawn_takes_nothing_from_the_transmittance() -> None:
    gaussians, cameras = straight_ahead([0.5, 0.99, 0.99], 9)
    gaussians.means[0, 0, 0] = 8.3 * DEPTH / FOCAL  # 3.2 standard deviations aside: an alpha of 0.003
    assert not decided(gaussians, cameras)


def test_pixels_without_gaussians_are_decided() -> None:
    """And where nothing is seen all agree."""
    gaussians, cameras = straight_ahead([0.5], 9)
    assert decided(gaussians, cameras, 1000.0)
    behind = replace(gaussians, means=-gaussians.means)
    assert decided(behind, cameras)
    row = compare(TiledRasterizer(), behind.to(torch.float32), cameras.to(torch.float32))
    assert (row["agrees"], row["depth"]) == (True, 0)


def test_undecided_pixels_are_left_out() -> None:
    gaussians, cameras = straight_ahead([0.99, 0.99], 3, torch.float32)

    def wrong_in_the_middle(images: Rendering) -> Rendering:
        images.color[..., 1, 1] += 1
        return images

    row = compare(changed(wrong_in_the_middle), gaussians, cameras)
    assert row["agrees"]
    assert 0 < row["undecided"] < PIXELS_PER_VIEW
    middle_only = replace(cameras, intrinsics=cameras.intrinsics - torch.tensor([[0, 0, 1.0], [0, 0, 1], [0, 0, 0]]))
    row = compare(TiledRasterizer(), gaussians, replace(middle_only, image_size=(1, 1)))
    assert (row["agrees"], row["pixels"], row["color"]) == (False, 0, None)  # nothing was compared
