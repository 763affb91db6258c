"""The benchmark's figures for people."""

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from completesplat.reports.tables import Column, table

SPEED: list[Column] = [
    ("backend", "backend", ""),
    ("size", "size", ""),
    ("Gaussians", "gaussians", ","),
    ("views", "views", ""),
    ("opacity", "opacity", ""),
    ("forward\nms", "forward_ms", ",.1f"),
    ("with backward\nms", "forward_backward_ms", ",.1f"),
    ("times\ntiled", "times_tiled", ",.1f"),
    ("peak\nMB", "peak_mb", ",.0f"),
]
GROWTH: list[Column] = [("along", "axis", ""), *(column for column in SPEED if column[1] != "opacity")]
STEP: list[Column] = [
    ("backend", "backend", ""),
    ("size", "size", ""),
    ("batch", "batch", ""),
    ("views", "views", ""),
    ("step\nms", "step_ms", ",.0f"),
    ("rasterizer\nms", "rasterizer_ms", ",.1f"),
    ("share", "share", ".1%"),
]
AGREEMENT: list[Column] = [
    ("backend", "backend", ""),
    ("agrees", "agrees", ""),
    ("colour", "color", ".1e"),
    ("depth", "depth", ".1e"),
    ("alpha", "alpha", ".1e"),
    ("pixels\ncompared", "pixels", ""),
    ("left out", "undecided", ""),
]
# Key in the results, title, columns.
SECTIONS = [
    ("rows", "Speed", SPEED),
    ("growth", "Growth", GROWTH),
    ("training_step", "Share of a training step", STEP),
    (
        "agreement",
        "Largest differences from the float64 reference (colour and alpha absolute, depth relative)",
        AGREEMENT,
    ),
]
WORKLOAD = ("axis", "size", "gaussians", "views", "opacity")


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results."""
    machine = results["machine"]
    # No markup: a reason may hold brackets, `pip install "completesplat[cuda]"` for one.
    console = Console(width=None if Console().is_terminal else 120, markup=False)
    console.print(f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']}, {machine['date']}")
    for key, title, columns in SECTIONS:
        rows = results.get(key, [])
        if rows:
            compared = against_tiled(rows) if key in ("rows", "growth") else rows
            console.print(table(title, columns, compared))
    for name, reason in results["not_measured"].items():
        console.print(f"{name}: not measured, because {reason}")


def against_tiled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with how many times slower than `tiled` on the same workload they are, forward and backward."""

    def workload(row: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(row.get(key) for key in WORKLOAD)

    tiled = {workload(row): row["forward_backward_ms"] for row in rows if row["backend"] == "tiled"}
    ratios = [row["forward_backward_ms"] / tiled[workload(row)] if workload(row) in tiled else None for row in rows]
    return [row | {"times_tiled": ratio} for row, ratio in zip(rows, ratios, strict=True)]
