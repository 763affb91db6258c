"""`completesplat bench cost`: durations of whole trainings, from the steps that `bench paper` measured."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

from completesplat.benchmarks.printing import device_of, print_results
from completesplat.commands.protocol import write_json
from completesplat.errors import CompleteSplatError
from completesplat.results.tables import Column, table
from completesplat.settings.schema import Entries, Positive

DAY_MS = 24 * 3600 * 1000


class WholeTraining(TypedDict):
    """A training: the measured step that it repeats, and its number of steps."""

    step: Literal["stage1_step", "stage2_step"]
    steps: Positive


def run(
    measured: str, trainings: Mapping[str, WholeTraining], gpus: Annotated[Sequence[Positive], Entries(1)], out: Path
) -> None:
    """Write `cost.json`, and print the days that each training takes on each number of GPUs.

    Raises:
        CompleteSplatError: `measured` is not a result of `bench paper`, or has no training steps.
    """
    results = _read(Path(measured))
    rows = bill(results["rows"], trainings, gpus)
    if not rows:
        raise CompleteSplatError(f"{measured} has no training steps: bench paper measures them with training=true")
    write_json(out / "cost.json", {"machine": results["machine"], "workload": results["workload"], "rows": rows})
    columns: list[Column] = [("training", "training", ""), ("steps", "steps", ",d"), ("", "way", "")]
    columns += [("ms a step", "ms", ",.0f"), ("memory\nMB", "memory_mb", ",.0f")]
    columns += [(f"days on {count}", f"days_{count}", ",.1f") for count in gpus]
    work = results["workload"]
    title = f"{work['image_size']} x {work['image_size']} pixels, {work['batch']} scenes a step, on {work['device']}"
    print_results(results, device_of(results), [table(title, columns, rows)], width=140)
    print("Several divide the scenes of a step without loss: no less time than this. Reading data, validation and")
    print("checkpoints are not counted.")


def bill(
    rows: Sequence[Mapping[str, Any]], trainings: Mapping[str, WholeTraining], gpus: Sequence[int]
) -> list[dict[str, Any]]:
    """Return a row for each training and each way in which its step was measured."""
    return [
        {"training": name, "steps": training["steps"], "way": row["way"], "ms": row["ms"]}
        | {key: row[key] for key in ("memory_mb",) if key in row}
        | {f"days_{count}": training["steps"] * row["ms"] / count / DAY_MS for count in gpus}
        for name, training in trainings.items()
        for row in rows
        if row["name"] == training["step"] and "ms" in row
    ]


def _read(path: Path) -> dict[str, Any]:
    try:
        results: dict[str, Any] = json.loads(path.read_text())
        missing = {"machine", "workload", "rows"} - results.keys()
    except (OSError, ValueError, AttributeError) as error:
        raise CompleteSplatError(f"measured={path}: no result of bench paper ({type(error).__name__})") from error
    if missing:
        raise CompleteSplatError(f"measured={path}: no result of bench paper (no {', '.join(sorted(missing))})")
    return results
