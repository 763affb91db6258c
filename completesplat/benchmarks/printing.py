"""Printing of a benchmark's results: the machine, the tables, and the parts that were not measured."""

from collections.abc import Iterable
from typing import Any

from rich.console import Console

from completesplat.results.tables import Table


def print_results(results: dict[str, Any], where: str, tables: Iterable[Table | str], width: int = 120) -> None:
    """Print a line about the machine, the tables, and a line for each part that was not measured.

    Args:
        results: contain `machine`, and perhaps `not_measured`, reasons by the name of the part.
        where: the processor or the GPU that was measured.
        width: number of columns if the output is not a terminal.
    """
    machine = results["machine"]
    # No markup, because a reason may contain brackets, as in `pip install "completesplat[cuda]"`.
    console = Console(width=None if Console().is_terminal else width, markup=False)
    console.print(f"{where}, torch {machine['torch']}, {machine['date']}")
    for part in tables:
        console.print(part)
    for name, reason in results.get("not_measured", {}).items():
        console.print(f"{name}: not measured, because {reason}")


def device_of(results: dict[str, Any]) -> str:
    """Return the name of the workload's device: the GPU, or the processor with its number of threads."""
    machine = results["machine"]
    if results.get("workload", {}).get("device") == "cuda":
        return str(machine["gpu"])
    return f"{machine['processor']}, {machine['threads']} threads"
