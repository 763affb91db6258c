"""The backends side by side: which of them work, speed, growth, and how they are shown."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from rich.console import Console
from support import compose_config

from completesplat.benchmarks import rasterizers, workloads
from completesplat.benchmarks.rasterizers import (
    CLASSES,
    GROWTH,
    LONGEST_SECONDS,
    SPEED,
    against_tiled,
    growth_rows,
    show,
    side_by_side,
    speed_rows,
    working_backends,
)
from completesplat.benchmarks.workloads import Backend, splatter_scene
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.results.tables import table

TILED = "completesplat.rasterizers.tiled.TiledRasterizer"


class Broken(ReferenceRasterizer):
    def __call__(self, gaussians, cameras):
        raise RuntimeError("no kernel\n  for this [processor]")


class NoBackward(ReferenceRasterizer):
    def __call__(self, gaussians, cameras):
        return super().__call__(gaussians.detach(), cameras)


@pytest.mark.parametrize(
    ("backend", "reason"),
    [(Broken, "no kernel for this [processor]"), (NoBackward, "grad"), (None, "completesplat.nowhere")],
)
def test_one_that_fails_is_absent_with_its_reason(monkeypatch: pytest.MonkeyPatch, backend, reason: str) -> None:
    if backend is None:
        monkeypatch.setitem(CLASSES, "tiled", "completesplat.nowhere.Rasterizer")
    else:
        monkeypatch.setattr(TILED, backend)
    found, absent = working_backends(["tiled", "reference"], RenderingConstants())
    assert [backend.name for backend in found] == ["reference"]
    assert list(absent) == ["tiled"]
    assert reason in absent["tiled"]


def test_the_order_is_kept_the_constants_arrive_and_an_unknown_name_is_refused() -> None:
    constants, config = RenderingConstants(max_alpha=0.9), compose_config("bench")
    for names in (["tiled", "reference"], ["reference", "tiled"]):
        found, absent = working_backends(names, constants)
        assert absent == {}
        assert [backend.name for backend in found] == names
        assert all(backend.rasterizer.constants == constants for backend in found)
    with pytest.raises(CompleteSplatError, match=r"'nonsense'.* reference, .* tiled, cuda"):
        working_backends(["tiled", "nonsense"], constants)
    assert {*config.backends, *config.growth.backends, *config.training_step.backends} == set(CLASSES)


class Clock:
    """Stands still, but while a rasterizer draws."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.turns: list[str] = []
        for module in (rasterizers, workloads):
            monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: self.now))

    def backend(self, name: str, *seconds: float) -> Backend:
        """Takes these times in turn to draw, then the last of them for ever."""
        left = list(seconds)

        def draw(gaussians: Gaussians, cameras: Cameras) -> Rendering:
            self.turns.append(name)
            self.now += left.pop(0) if len(left) > 1 else left[0]
            value = sum(tensor.mean() for tensor in vars(gaussians).values())
            shape = cameras.intrinsics.shape[:2]
            return Rendering(*(value.expand(*shape, channels, *cameras.image_size) for channels in (3, 1, 1)))

        return Backend(name, draw)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_there_is_one_row_for_each_backend_and_workload(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """But the reference is spared large ones."""
    monkeypatch.setattr(workloads, "MOST_REFERENCE_PAIRS", 2 * 8**2 * 8**2)  # size 8 in one view, just
    said: list[str] = []
    milliseconds = {"tiled": 250, "other": 500, "reference": 750}
    chosen = [clock.backend(name, time / 1000) for name, time in milliseconds.items()]
    found = speed_rows(chosen, [8, 12], [1, 3], 2, said.append)
    given = [(size, 2 * size**2, views, o) for size in (8, 12) for views in (1, 3) for o in ("trained", "initial")]
    seen = [tuple(row[key] for key in ("size", "gaussians", "views", "opacity", "backend")) for row in found]
    assert seen == [
        (*work, name) for work in given for name in milliseconds if name != "reference" or work in given[:2]
    ]
    for row in found:
        assert row["forward_ms"] == row["forward_backward_ms"] == milliseconds[row["backend"]]
        assert row["peak_mb"] is None or row["peak_mb"] >= 0
    assert len(said) == len(given)


def test_backends_take_turns_and_the_time_is_the_median_without_the_first_run(clock: Clock, monkeypatch) -> None:
    """One that took too long at first, or has by now, is not run again."""
    slow, quick = clock.backend("slow", LONGEST_SECONDS + 1, 1.0), clock.backend("quick", 1.0, 0.5, 0.125, 0.25)
    chosen = [slow, quick, clock.backend("other", 0.1)]
    figures = side_by_side(chosen, *splatter_scene(4, 1, "trained"), repeats=3)
    assert clock.turns == ["slow", *["quick", "other"] * 4]  # one for the memory, three for the time
    assert figures["slow"]["forward_ms"] == (LONGEST_SECONDS + 1) * 1000
    assert figures["quick"]["forward_ms"] == 250
    clock.turns.clear()
    monkeypatch.setattr(rasterizers, "LONGEST_SECONDS", 4.0)
    figures = side_by_side([clock.backend("a", 1.5)], *splatter_scene(4, 1, "trained"), repeats=9)
    assert len(clock.turns) == 3
    assert figures["a"]["forward_ms"] == 1500


BLUE, ORANGE = (31, 119, 180), (255, 127, 14)  # matplotlib's first two colours


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = {"SOURCE_SIZES": (3, 4, 6, 23), "SOURCE_SIZE": 5}
    for name, value in (scenes | {"IMAGE_SIZE": 8, "VIEWS": (1, 2, 3), "IMAGE_SIZES": (4, 7)}).items():
        monkeypatch.setattr(rasterizers, name, value)


def test_every_axis_is_measured_with_the_others_held(small) -> None:
    seen: list[tuple[int, int, int]] = []

    def draw(gaussians, cameras) -> Rendering:
        seen.append((gaussians.count, cameras.intrinsics.shape[1], cameras.image_size[0]))
        return ReferenceRasterizer()(gaussians, cameras)

    said: list[str] = []
    rows = growth_rows([Backend("tiled", draw)], said.append, most_gaussians=1000)
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


def test_one_that_took_too_long_is_spared_the_rest_of_that_axis_only(small, monkeypatch: pytest.MonkeyPatch) -> None:
    def side_by_side(backends: Sequence[Backend], gaussians, cameras, repeats: int) -> dict[str, dict[str, float]]:
        weary = gaussians.count == 32 or cameras.intrinsics.shape[1] == 2
        times = {"slow": rasterizers.PATIENCE_MS + weary, "quick": rasterizers.PATIENCE_MS}
        return {backend.name: {"forward_backward_ms": times[backend.name]} for backend in backends}

    monkeypatch.setattr(rasterizers, "side_by_side", side_by_side)
    backends = [Backend(name, ReferenceRasterizer()) for name in ("slow", "quick")]
    rows = growth_rows(backends, lambda _: None, most_gaussians=72)  # no more than these
    found = {name: [row[row["axis"]] for row in rows if row["backend"] == name] for name in ("slow", "quick")}
    # Gaussians, views and sizes; the one that took too long still counts.
    assert found == {"slow": [18, 32, 1, 2, 4, 7], "quick": [18, 32, 72, 1, 2, 3, 4, 7]}


def along(axis: str, backend: str, milliseconds: float, *values: int) -> list[dict[str, Any]]:
    held = {"backend": backend, "axis": axis, "gaussians": 50, "views": 1, "size": 8}
    return [held | {axis: value, "forward_backward_ms": milliseconds * value} for value in values]


def drawn(rows: list[dict[str, Any]], path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rasterizers.plot(rows, path)
    return imageio.imread(path)[..., :3]


def marks(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows of pixels, as fractions of the height, in which a colour occurs."""
    return np.flatnonzero((image == color).all(-1).any(1)) / len(image)


def test_a_backend_has_one_color_in_all_panels(tmp_path: Path) -> None:
    """Even where one that comes before it was measured along one axis only; an axis without points is left empty."""
    slow_then_fast = along("size", "reference", 1e5, 4) + along("size", "tiled", 1.0, 4, 7)
    image = drawn(slow_then_fast + along("views", "tiled", 1.0, 1, 4), tmp_path / "plot.png")
    first, second, last = np.array_split(image, 3, axis=1)
    assert not marks(first, ORANGE).size
    assert not marks(first, BLUE).size
    assert not marks(second, BLUE).size
    assert np.ptp(marks(second, ORANGE)) > 0.05  # it rises
    # Below is the faster one.
    assert (marks(last, ORANGE) > 0.5).any()
    assert not (marks(last, BLUE) > 0.5).any()
    assert (marks(last, BLUE) < 0.5).any()


def row(backend: str, milliseconds: float, **workload: Any) -> dict[str, Any]:
    held = {"size": 64, "gaussians": 8192, "views": 1, "opacity": "trained", "peak_mb": None}
    return {"backend": backend, "forward_ms": 1.0, "forward_backward_ms": milliseconds} | held | workload


def test_backends_are_set_against_tiled_on_the_same_workload() -> None:
    for other in ({"size": 128}, {"gaussians": 99}, {"views": 4}, {"opacity": "initial"}, {"axis": "size"}):
        rows = [row("reference", 50.0), row("tiled", 10.0), row("tiled", 20.0, **other)]
        assert [found["times_tiled"] for found in against_tiled([*rows, row("a", 50.0, **other)])] == [5, 1, 1, 2.5]
        assert [found["times_tiled"] for found in against_tiled(rows[::2])] == [None, 1]


def test_all_that_was_measured_is_shown_with_the_machine(capsys: pytest.CaptureFixture[str]) -> None:
    step = {"backend": "tiled", "size": 64, "batch": 8, "views": 4, "step_ms": 500.0, "rasterizer_ms": 30.0}
    agreement = {"backend": "tiled", "agrees": False, "color": 1.5e-6, "alpha": 1.5e-6, "depth": None}
    reason = 'it needs gsplat: pip install "completesplat[cuda]"'
    results = {
        "machine": {"processor": "Some CPU", "threads": 2, "torch": "2.10", "date": "2026-01-31"},
        "not_measured": {"cuda": reason},
        "rows": [row("tiled", 10.0), row("gsplat_torch", 70.0)],
        "growth": [row("tiled", 10.0, axis="views")],
        "training_step": [step | {"share": 0.06}],
        "agreement": [agreement],
    }
    show(results)
    said = capsys.readouterr().out
    shown = ("Some CPU, 2 threads, torch 2.10, 2026-01-31", "6.0%", f"cuda: not measured, because {reason}")
    assert all(text in said for text in (*shown, "Speed", "Growth", "Share of a training step"))
    (line,) = (line for line in said.splitlines() if "False" in line)
    assert line.count("1.5e-06") == 2
    (line,) = (line for line in said.splitlines() if "gsplat_torch" in line)
    assert "7.0" in line


def test_the_tables_of_speed_fit_a_page() -> None:
    largest = row("gsplat_torch", 123_456.7, axis="gaussians", gaussians=1_048_352, forward_ms=123_456.7)
    for columns in (SPEED, GROWTH):
        shown = table("Title", columns, [largest | {"peak_mb": 123_456.7, "times_tiled": 1234.5}])
        assert Console(width=1000).measure(shown).maximum <= 120
