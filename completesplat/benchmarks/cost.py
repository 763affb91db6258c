"""`completesplat bench cost`: durations of whole trainings, from the steps that `bench paper` measured."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from completesplat.benchmarks.measuring import Row, report
from completesplat.errors import CompleteSplatError
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
    try:
        results = json.loads(Path(measured).read_text())
        machine, work, steps = results["machine"], results["workload"], results["rows"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CompleteSplatError(f"measured={measured}: no result of bench paper ({error!r})") from error
    rows: list[Row] = [
        {"training": name, "steps": training["steps"], "way": step["way"], "ms": step["ms"]}
        | {key: step[key] for key in ("memory_mb",) if key in step}
        | {f"days_{count}": training["steps"] * step["ms"] / count / DAY_MS for count in gpus}
        for name, training in trainings.items()
        for step in steps
        if step["name"] == training["step"] and "ms" in step
    ]
    if not rows:
        raise CompleteSplatError(f"{measured} has no training steps: bench paper measures them with training=true")
    title = f"{work['image_size']} x {work['image_size']} pixels, {work['batch']} scenes a step, on {work['device']}"
    costs = {"machine": machine, "workload": work, "rows": rows}
    report(out / "cost.json", costs, {title: rows}, work["device"])
    print("At least this long: GPUs divide the scenes of a step without loss; reading data, validation and")
    print("checkpoints are not counted.")
