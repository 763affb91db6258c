"""The figures for people."""

from typing import Any

from rich.console import Console

from completesplat.reports.tables import Column, table

READING: list[Column] = [
    ("form", "form", ""),
    ("workers", "workers", "d"),
    ("batches\nper s", "batches_per_second", ",.1f"),
    ("scenes\nper s", "scenes_per_second", ",.0f"),
    ("images\nper s", "images_per_second", ",.0f"),
    ("times\nthe first", "times_first", ",.1f"),
]
DECODING: Column = ("share of\ndecoding", "decoding_share", ".0%")
STEPS: list[Column] = [
    ("after", "after", ""),
    ("seconds", "seconds", ",.2f"),
    ("own memory\nMB", "anonymous_mb", ",.0f"),
    ("mapped files\nMB", "file_mb", ",.0f"),
]


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results."""
    machine = results["machine"]
    console = Console(width=None if Console().is_terminal else 120, markup=False)
    console.print(f"{machine['processor']}, {machine['cores']} cores, torch {machine['torch']}, {machine['date']}")
    console.print(table("Training batches", [*READING, DECODING], results["rows"]))
    if "opening" in results:
        opening = results["opening"]
        console.print(table(f"A prepared store of {opening['sequences']:,} sequences", STEPS, opening["steps"]))
    if "clips" in results:
        console.print(table("Training batches of clips", READING, results["clips"]))
        chunks = results["chunks"]
        size, read, most = chunks["largest_mb"], chunks["read_in_an_epoch"], chunks["most_in_memory"]
        console.print(
            f"{chunks['files']} chunks of up to {size:.1f} MB: {read} read in an epoch, {most} in memory at once"
        )
    for name, reason in results["not_measured"].items():
        console.print(f"{name}: not measured, because {reason}")
