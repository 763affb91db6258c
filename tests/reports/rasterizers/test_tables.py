"""Tables of the benchmark, for people."""

from typing import Any

import pytest
from rich.console import Console

from completesplat.benchmarks.rasterizers import AGREEMENT, GROWTH, SPEED, against_tiled, show
from completesplat.results.tables import Table, table

MACHINE = {"processor": "Some CPU", "threads": 2, "torch": "2.10", "date": "2026-01-31"}
REASON = 'it needs gsplat: pip install "completesplat[cuda]"'


def row(backend: str, milliseconds: float, **workload: Any) -> dict[str, Any]:
    held = {"size": 64, "gaussians": 8192, "views": 1, "opacity": "trained", "peak_mb": 12.3}
    return {"backend": backend, "forward_ms": 1.0, "forward_backward_ms": milliseconds} | held | workload


def cells(shown: Table, heading: str) -> list[str]:
    (index,) = (index for index, found in enumerate(shown.headings) if " ".join(found.text.split()) == heading)
    return [row.cells[index].text for row in shown.rows]


@pytest.mark.parametrize(
    "other", [{"size": 128}, {"gaussians": 99}, {"views": 4}, {"opacity": "initial"}, {"axis": "size"}]
)
def test_backends_are_set_against_tiled_on_the_same_workload(other: dict[str, Any]) -> None:
    rows = [row("reference", 50.0), row("tiled", 10.0), row("tiled", 20.0, **other), row("torch_tiled", 50.0, **other)]
    assert [found["times_tiled"] for found in against_tiled(rows)] == [5, 1, 1, 2.5]
    alone = [row("reference", 50.0), row("tiled", 20.0, **other)]
    assert [found["times_tiled"] for found in against_tiled(alone)] == [None, 1]


def test_missing_figures_stay_empty() -> None:
    rows = [row("tiled", 1234.56, peak_mb=None), row("reference", 0.04)]
    shown = table("Speed", SPEED, rows)
    assert len(shown.rows) == 2
    assert cells(shown, "peak MB") == ["", "12"]
    assert cells(shown, "times tiled") == ["", ""]
    assert cells(shown, "with backward ms") == ["1,234.6", "0.0"]
    assert cells(shown, "Gaussians") == ["8,192", "8,192"]


def test_what_does_not_agree_is_told() -> None:
    figures = {"backend": "tiled", "color": 1.5e-6, "depth": None, "alpha": 0.0, "pixels": 380, "undecided": 4}
    shown = table("Agreement", AGREEMENT, [figures | {"agrees": False}])
    assert [cells(shown, heading) for heading in ("agrees", "colour", "depth")] == [["False"], ["1.5e-06"], [""]]


def test_all_that_was_measured_is_shown_with_the_machine(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row("tiled", 10.0), row("torch_tiled", 70.0)]
    step = {"backend": "tiled", "size": 64, "batch": 8, "views": 4, "step_ms": 500.0, "rasterizer_ms": 30.0}
    results = {
        "machine": MACHINE,
        "not_measured": {"cuda": REASON},
        "rows": rows,
        "growth": [row("tiled", 10.0, axis="views")],
        "training_step": [step | {"share": 0.06}],
    }
    show(results)
    said = capsys.readouterr().out
    assert "Some CPU, 2 threads, torch 2.10, 2026-01-31" in said
    assert "6.0%" in said
    assert all(title in said for title in ("Speed", "Growth", "Share of a training step"))
    assert "Largest differences" not in said
    (line,) = (line for line in said.splitlines() if "torch_tiled" in line)
    assert "7.0" in line
    assert f"cuda: not measured, because {REASON}" in said


def test_the_tables_of_speed_fit_a_page() -> None:
    largest = row("gsplat_torch", 123_456.7, axis="gaussians", gaussians=1_048_352, forward_ms=123_456.7)
    for columns in (SPEED, GROWTH):
        shown = table("Title", columns, [largest | {"peak_mb": 123_456.7, "times_tiled": 1234.5}])
        assert Console(width=1000).measure(shown).maximum <= 120
