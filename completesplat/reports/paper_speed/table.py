"""The figures for people."""

from typing import Any

from rich.console import Console

from completesplat.reports.paper_speed.figures import FIGURES
from completesplat.reports.tables import Column, table

COLUMNS: list[Column] = [
    ("", "text", ""),
    ("", "way", ""),
    ("ms", "ms", ",.1f"),
    ("paper, A100\nms", "paper_ms", ",.1f"),
    ("aim\nms", "aim_ms", ",.0f"),
    ("memory\nMB", "memory_mb", ",.0f"),
    ("", "not_measured", ""),
]


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results, the ways of one work next to each other."""
    machine, work = results["machine"], results["workload"]
    console = Console(width=None if Console().is_terminal else 140, markup=False)
    where = machine["gpu"] if work["device"] == "cuda" else f"{machine['processor']}, {machine['threads']} threads"
    console.print(f"{where}, torch {machine['torch']}, {machine['date']}")
    order = list(FIGURES)
    rows = sorted(results["rows"], key=lambda row: order.index(row["name"]))
    size = work["image_size"]
    drawn = f"{work['samples']} samples in {work['steps']} steps"
    title = f"{size} x {size} pixels, {drawn}, training batches of {work['batch']}"
    console.print(table(title, COLUMNS, [row | {"text": FIGURES[row["name"]].text} for row in rows]))
