"""`completesplat bench rasterizers`: which backends work, how they are timed, and what is written and refused."""

from types import SimpleNamespace

import pytest
from support import compose_config, strict_json

from completesplat.benchmarks import rasterizers
from completesplat.benchmarks.rasterizers import (
    BACKENDS,
    LONGEST_SECONDS,
    Backend,
    side_by_side,
    speed_rows,
    splatter_scene,
    working_backends,
)
from completesplat.errors import CompleteSplatError
from completesplat.evaluation import scorer
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants, selection
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import failure


class Broken(ReferenceRasterizer):
    def __call__(self, gaussians, cameras):
        raise RuntimeError("no kernel\n  for this [processor]")


def test_a_failing_backend_is_absent_with_its_reason(command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(selection.FASTER, "tiled", Broken)
    failure.cache_clear()
    backends, absent = working_backends(["tiled", "reference"], RenderingConstants())
    reason = "tiled: not measured, because RuntimeError: no kernel for this [processor]"
    assert command.refuses("bench", "rasterizers", "backends=[tiled]") == reason
    failure.cache_clear()
    assert [backend.name for backend in backends] == ["reference"]
    assert absent == {"tiled": "RuntimeError: no kernel for this [processor]"}


def test_backends_keep_their_order_and_get_the_constants_and_an_unknown_name_is_refused() -> None:
    constants, config = RenderingConstants(max_alpha=0.9), compose_config("bench")
    for names in (["tiled", "reference"], ["reference", "tiled"]):
        backends, absent = working_backends(names, constants)
        assert absent == {}
        assert [backend.name for backend in backends] == names
        assert all(backend.rasterizer.constants == constants for backend in backends)
    with pytest.raises(CompleteSplatError, match=r"'nonsense'.* reference, cuda, tiled"):
        working_backends(["tiled", "nonsense"], constants)
    assert {*config.backends} == set(BACKENDS)


class Clock:
    """A clock that stands still except while a rasterizer renders."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.turns: list[str] = []
        for module in (rasterizers, scorer):
            monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: self.now))

    def backend(self, name: str, *seconds: float) -> Backend:
        """Return a backend that takes these times in turn, and then the last one each time."""
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
    """The reference skips large workloads."""
    monkeypatch.setattr(rasterizers, "MOST_REFERENCE_PAIRS", 2 * 8**2 * 8**2)  # size 8 in one view, just
    messages: list[str] = []
    milliseconds = {"tiled": 250, "other": 500, "reference": 750}
    backends = [clock.backend(name, time / 1000) for name, time in milliseconds.items()]
    rows = speed_rows(backends, [8, 12], [1, 3], 2, messages.append)
    works = [(size, 2 * size**2, views, o) for size in (8, 12) for views in (1, 3) for o in ("trained", "initial")]
    keys = [tuple(row[key] for key in ("size", "gaussians", "views", "opacity", "backend")) for row in rows]
    expected = [(*work, name) for work in works for name in milliseconds if name != "reference" or work in works[:2]]
    assert keys == expected
    for row in rows:
        assert row["forward_ms"] == row["forward_backward_ms"] == milliseconds[row["backend"]]
        assert row["peak_mb"] is None or row["peak_mb"] >= 0
    assert len(messages) == len(works)


def test_backends_take_turns_and_the_time_is_the_median_without_the_first_run(clock: Clock, monkeypatch) -> None:
    """A backend that took too long, at first or in total, is not run again."""
    slow, quick = clock.backend("slow", LONGEST_SECONDS + 1, 1.0), clock.backend("quick", 1.0, 0.5, 0.125, 0.25)
    backends = [slow, quick, clock.backend("other", 0.1)]
    figures = side_by_side(backends, *splatter_scene(4, 1, "trained"), repeats=3)
    assert clock.turns == ["slow", *["quick", "other"] * 4]  # one for the memory, three for the time
    assert figures["slow"]["forward_ms"] == (LONGEST_SECONDS + 1) * 1000
    assert figures["quick"]["forward_ms"] == 250
    clock.turns.clear()
    monkeypatch.setattr(rasterizers, "LONGEST_SECONDS", 4.0)
    figures = side_by_side([clock.backend("a", 1.5)], *splatter_scene(4, 1, "trained"), repeats=9)
    assert len(clock.turns) == 3
    assert figures["a"]["forward_ms"] == 1500


def test_backends_are_compared_with_tiled_on_the_same_workload(clock: Clock) -> None:
    backends = [clock.backend(name, seconds) for name, seconds in {"reference": 0.5, "tiled": 0.25}.items()]
    assert [row["times_tiled"] for row in speed_rows(backends, [4], [1], 1, print)] == [2, 1] * 2
    assert not any("times_tiled" in row for row in speed_rows(backends[:1], [4], [1], 1, print))


QUICK = ["bench", "rasterizers", "sizes=[16]", "views=[1]", "repeats=1"]


def test_results_are_written_and_printed(command, tmp_path, monkeypatch):
    """A backend that does not work on this machine is named with the reason."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    finished = command.succeeds(*QUICK, "backends=[tiled,reference,cuda]", f"out={tmp_path / 'out'}")
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    results = strict_json(tmp_path / "out/rasterizers.json")
    assert "CUDA device" in results["not_measured"]["cuda"]
    works = [(name, opacity) for opacity in ("trained", "initial") for name in ("tiled", "reference")]
    assert [(row["backend"], row["opacity"]) for row in results["rows"]] == works
    assert {(row["size"], row["gaussians"], row["views"]) for row in results["rows"]} == {(16, 512, 1)}
    missing = f"cuda: not measured, because {results['not_measured']['cuda']}"
    texts = ("Speed", results["machine"]["processor"], missing)
    assert all(text in finished.out for text in texts)
