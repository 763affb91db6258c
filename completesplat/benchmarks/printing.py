"""How the results of a benchmark are printed: the machine, its tables, and what could not be measured."""

from collections.abc import Iterable
from typing import Any

from rich.console import Console

from completesplat.results.tables import Table


def print_results(results: dict[str, Any], where: str, tables: Iterable[Table | str], width: int = 120) -> None:
    """Print a line about the machine, the tables, and a line for each part that was not measured.

    Args:
        results: with `machine`; `not_measured`, if it is there, holds reasons by the name of the part.
        where: the processor or the GPU that was measured.
        width: columns, where the output is no terminal.
    """
    machine = results["machine"]
    # No markup: a reason may hold brackets, `pip install "completesplat[cuda]"` for one.
    console = Console(width=None if Console().is_terminal else width, markup=False)
    console.print(f"{where}, torch {machine['torch']}, {machine['date']}")
    for one in tables:
        console.print(one)
    for name, reason in results.get("not_measured", {}).items():
        console.print(f"{name}: not measured, because {reason}")


def device_of(results: dict[str, Any]) -> str:
    """The GPU, or the processor with the number of its threads, by the device of the workload."""
    machine = results["machine"]
    if results.get("workload", {}).get("device") == "cuda":
        return str(machine["gpu"])
    return f"{machine['processor']}, {machine['threads']} threads"
