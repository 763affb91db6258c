"""Timing of work on a device, and printing of the results: parts of all benchmarks."""

import time
from collections.abc import Callable, Iterable, Mapping

import torch
from rich.console import Console

from completesplat.results.tables import Table

Work = Callable[[], object]
Row = dict[str, object]  # of a table; its values can be written as JSON
WARM_UP = 2  # untimed calls


def finished(device: torch.device) -> float:
    """Wait until the device has finished its work, and return the time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def milliseconds(work: Work, device: torch.device) -> float:
    """Return the time of one call, until the device has finished it."""
    start = finished(device)
    work()
    return (finished(device) - start) * 1e3


def device_name(machine: Mapping[str, object], device: object = "cpu") -> str:
    """Return the name of the GPU ("cuda"), or that of the processor with its number of threads."""
    return str(machine["gpu"]) if device == "cuda" else f"{machine['processor']}, {machine['threads']} threads"


def print_results(
    machine: Mapping[str, object], device: str, tables: Iterable[Table], not_measured: Mapping[str, str] | None = None
) -> None:
    """Print a line about the machine and the device, the tables, and reasons for parts that were not measured."""
    # No markup, because a reason may contain brackets, as in `pip install "completesplat[cuda]"`.
    console = Console(width=None if Console().is_terminal else 140, markup=False)
    console.print(f"{device}, torch {machine['torch']}, {machine['date']}")
    for table in tables:
        console.print(table)
    for name, reason in (not_measured or {}).items():
        console.print(f"{name}: not measured, because {reason}")
