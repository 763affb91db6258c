"""Timing of work, and output of the results: parts of all benchmarks."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from completesplat.evaluation.provenance import machine
from completesplat.evaluation.scorer import synchronized_time
from completesplat.evaluation.tables import records_table, show
from completesplat.files import write_json

Work = Callable[[], object]
Row = dict[str, object]  # of a table; its values can be written as JSON
WARM_UP = 2  # untimed calls


def milliseconds(work: Work) -> float:
    """Return the time of one call in ms, including its work on the GPU."""
    start = synchronized_time()
    work()
    return (synchronized_time() - start) * 1e3


def report(path: Path, results: Mapping[str, Any], tables: Mapping[str, Sequence[Row]], device: object = "cpu") -> None:
    """Write results to a JSON file; print the machine, the tables, and the reasons for what was not measured.

    Args:
        results: content of the file; `not_measured` has reasons by name.
        tables: rows by title.
        device: "cuda", or anything else for the processor.
    """
    here = machine()
    write_json(path, {"machine": here, **results})
    name = here["gpu"] if device == "cuda" else f"{here['processor']}, {here['threads']} threads"
    print(f"{name}, torch {here['torch']}, {here['date']}")
    show(*(records_table(title, rows) for title, rows in tables.items()), width=140)
    for part, reason in results.get("not_measured", {}).items():
        print(f"{part}: not measured, because {reason}")
