"""Growth along three axes: which points are measured, and the plot of them."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from completesplat.benchmarks import rasterizers
from completesplat.benchmarks.rasterizers import Backend
from completesplat.rasterizers import Rendering
from completesplat.rasterizers.reference import ReferenceRasterizer

BLUE, ORANGE = (31, 119, 180), (255, 127, 14)  # matplotlib's first two colours


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"SOURCE_SIZES": (3, 4, 6), "IMAGE_SIZE": 8, "SOURCE_SIZE": 5, "VIEWS": (1, 2, 3), "IMAGE_SIZES": (4, 7)}
    for name, value in values.items():
        monkeypatch.setattr(rasterizers, name, value)


def named(*names: str) -> list[Backend]:
    return [Backend(name, ReferenceRasterizer()) for name in names]


def points(rows: list[dict[str, Any]], backend: str, axis: str) -> list[int]:
    return [row[axis] for row in rows if row["backend"] == backend and row["axis"] == axis]


def test_every_axis_is_measured_with_the_others_held() -> None:
    seen: list[tuple[int, int, int]] = []

    def draw(gaussians, cameras) -> Rendering:
        seen.append((gaussians.count, cameras.intrinsics.shape[1], cameras.image_size[0]))
        return ReferenceRasterizer()(gaussians, cameras)

    said: list[str] = []
    rows = rasterizers.rows([Backend("tiled", draw)], said.append, most_gaussians=1000)
    found = [(row["axis"], row["gaussians"], row["views"], row["size"]) for row in rows]
    assert found == [
        *(("gaussians", 2 * size**2, 1, 8) for size in (3, 4, 6)),
        *(("views", 50, views, 5) for views in (1, 2, 3)),
        *(("size", 50, 1, size) for size in (4, 7)),
    ]
    assert list(dict.fromkeys(seen)) == [workload for _, *rest in found if (workload := tuple(rest))]
    assert all(0 < row["forward_ms"] <= row["forward_backward_ms"] for row in rows)
    assert said == [
        f"growth with {axis}: {dict(zip(rasterizers.AXES, rest, strict=True))[axis]}" for axis, *rest in found
    ]


def test_no_more_gaussians_than_asked_for() -> None:
    rows = rasterizers.rows(named("tiled"), lambda _: None, most_gaussians=32)
    assert points(rows, "tiled", "gaussians") == [18, 32]
    assert points(rows, "tiled", "views") == [1, 2, 3]


def test_one_that_took_too_long_is_spared_the_rest_of_that_axis_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def side_by_side(backends: Sequence[Backend], gaussians, cameras, repeats: int) -> dict[str, dict[str, float]]:
        weary = gaussians.count == 32 or cameras.intrinsics.shape[1] == 2
        times = {"slow": rasterizers.PATIENCE_MS + weary, "quick": rasterizers.PATIENCE_MS}
        return {backend.name: {"forward_backward_ms": times[backend.name]} for backend in backends}

    monkeypatch.setattr(rasterizers, "side_by_side", side_by_side)
    rows = rasterizers.rows(named("slow", "quick"), lambda _: None, most_gaussians=1000)
    assert points(rows, "slow", "gaussians") == [18, 32]  # that one still counts
    assert points(rows, "slow", "views") == [1, 2]
    assert points(rows, "slow", "size") == [4, 7]
    assert points(rows, "quick", "gaussians") == [18, 32, 72]
    assert points(rows, "quick", "views") == [1, 2, 3]


def along(axis: str, backend: str, milliseconds: float, *values: int) -> list[dict[str, Any]]:
    held = {"gaussians": 50, "views": 1, "size": 8}
    return [
        {"backend": backend, "axis": axis} | held | {axis: value, "forward_backward_ms": milliseconds * value}
        for value in values
    ]


def drawn(rows: list[dict[str, Any]], path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rasterizers.plot(rows, path)
    return imageio.imread(path)[..., :3]


def marks(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows of pixels, as fractions of the height, in which a colour occurs."""
    return np.flatnonzero((image == color).all(-1).any(1)) / len(image)


def test_the_plot_of_one_backend_shows_a_curve_in_each_panel(tmp_path: Path) -> None:
    image = drawn([row for axis in rasterizers.AXES for row in along(axis, "tiled", 1.0, 1, 4)], tmp_path / "plot.png")
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    for panel in np.array_split(image, 3, axis=1):
        assert np.ptp(marks(panel, BLUE)) > 0.3  # it rises


def test_a_backend_has_one_color_in_all_panels(tmp_path: Path) -> None:
    """Even where one that comes before it was measured along one axis only; below, in each, is the faster one."""
    slow_then_fast = along("size", "reference", 1e5, 4) + along("size", "tiled", 1.0, 4, 7)
    rows = slow_then_fast + [row for axis in ("gaussians", "views") for row in along(axis, "tiled", 1.0, 1, 4)]
    image = drawn(rows, tmp_path / "plot.png")
    first, second, last = np.array_split(image, 3, axis=1)
    for panel in (first, second):
        assert marks(panel, ORANGE).size
        assert not marks(panel, BLUE).size
    assert (marks(last, ORANGE) > 0.5).any()
    assert not (marks(last, BLUE) > 0.5).any()
    assert (marks(last, BLUE) < 0.5).any()


def test_an_axis_without_points_is_left_empty(tmp_path: Path) -> None:
    rows = [row for axis in ("views", "size") for row in along(axis, "tiled", 1.0, 1, 4)]
    first, *others = np.array_split(drawn(rows, tmp_path / "plot.png"), 3, axis=1)
    assert not marks(first, BLUE).size
    assert all(marks(panel, BLUE).size for panel in others)
