"""The figures for people."""

from typing import Any

from rich.console import Console

from completesplat.reports.tables import Column, table

COMPARED: list[Column] = [
    ("a", "a", ""),
    ("b", "b", ""),
    ("a\nms", "a_ms", ",.1f"),
    ("b\nms", "b_ms", ",.1f"),
    ("times\nfaster", "ratio", ",.2f"),
]


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results."""
    machine, work = results["machine"], results["workload"]
    console = Console(width=None if Console().is_terminal else 120, markup=False)
    where = machine["gpu"] if work["device"] == "cuda" else f"{machine['processor']}, {machine['threads']} threads"
    console.print(f"{where}, torch {machine['torch']}, {machine['date']}")
    title = (
        f"{work['image_size']} x {work['image_size']} pixels, batch {work['batch']}, training in {work['precision']}"
    )
    console.print(table(title, COMPARED, results["rows"]))
    for name, reason in results["not_measured"].items():
        console.print(f"{name}: not measured, because {reason}")
