"""Side by side: who runs when, what is timed, what is left out. The clock is the test's own."""

from types import SimpleNamespace

import pytest

from completesplat.benchmarks import rasterizers, workloads
from completesplat.benchmarks.rasterizers import LONGEST_SECONDS, Backend, rows, side_by_side
from completesplat.benchmarks.workloads import splatter_scene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering

KEYS = {"backend", "size", "gaussians", "views", "opacity", "forward_ms", "forward_backward_ms", "peak_mb"}


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


def test_there_is_one_row_for_each_backend_and_workload(clock: Clock) -> None:
    said: list[str] = []
    found = rows([clock.backend("tiled", 0.25), clock.backend("other", 0.5)], [8, 12], [1, 3], 2, said.append)
    workloads = [(size, 2 * size**2, views, o) for size in (8, 12) for views in (1, 3) for o in ("trained", "initial")]
    seen = [tuple(row[key] for key in ("size", "gaussians", "views", "opacity", "backend")) for row in found]
    assert seen == [(*workload, name) for workload in workloads for name in ("tiled", "other")]
    assert all(set(row) == KEYS for row in found)
    for row in found:
        assert row["forward_ms"] == row["forward_backward_ms"] == {"tiled": 250, "other": 500}[row["backend"]]
        assert row["peak_mb"] is None or row["peak_mb"] >= 0
    assert len(said) == len(workloads)


def test_the_backends_take_turns(clock: Clock) -> None:
    side_by_side([clock.backend(name, 0.1) for name in "abc"], *splatter_scene(4, 1, "trained"), repeats=3)
    assert clock.turns == list("abc") * 4  # one for the memory, three for the time


def test_the_time_is_the_median_without_the_first_run(clock: Clock) -> None:
    figures = side_by_side([clock.backend("a", 1.0, 0.5, 0.125, 0.25)], *splatter_scene(4, 1, "trained"), repeats=3)
    assert figures["a"]["forward_ms"] == 250


def test_one_that_took_too_long_at_first_is_not_run_again(clock: Clock) -> None:
    slow, quick = clock.backend("slow", LONGEST_SECONDS + 1, 1.0), clock.backend("quick", 0.25)
    figures = side_by_side([slow, quick], *splatter_scene(4, 1, "trained"), repeats=3)
    assert clock.turns == ["slow", *["quick"] * 4]
    assert figures["slow"]["forward_ms"] == (LONGEST_SECONDS + 1) * 1000
    assert figures["quick"]["forward_ms"] == 250


def test_one_that_has_taken_too_long_by_now_is_not_run_again(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizers, "LONGEST_SECONDS", 4.0)
    figures = side_by_side([clock.backend("a", 1.5)], *splatter_scene(4, 1, "trained"), repeats=9)
    assert len(clock.turns) == 3
    assert figures["a"]["forward_ms"] == 1500


def test_the_reference_is_spared_large_workloads(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizers, "MOST_REFERENCE_PAIRS", 2 * 8**2 * 8**2)  # size 8 in one view, just
    chosen = [clock.backend("reference", 0.1), clock.backend("tiled", 0.1)]
    found = rows(chosen, [8, 9], [1, 2], 1, lambda _: None)
    of_reference = {(row["size"], row["views"]) for row in found if row["backend"] == "reference"}
    assert of_reference == {(8, 1)}
    assert {(row["size"], row["views"]) for row in found if row["backend"] == "tiled"} == {
        (size, views) for size in (8, 9) for views in (1, 2)
    }
