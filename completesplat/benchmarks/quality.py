"""`completesplat bench quality`: PSNR of novel views against the seconds and the steps of a training."""

import csv
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import accumulate
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple, TypedDict

from omegaconf import OmegaConf
from rich.console import Console

from completesplat.atomic import atomic_path
from completesplat.benchmarks.printing import print_results
from completesplat.commands.protocol import write_json
from completesplat.errors import CompleteSplatError
from completesplat.results.machine import machine
from completesplat.results.tables import Column, table
from completesplat.schema import Entries, Natural, Positive, Range

INTERVAL = 20  # steps from one row of speeds to the next
SPEED, WAITING, PSNR = "speed/scenes_per_second", "speed/data_wait", "val/psnr_novel"
COLUMNS: list[Column] = [
    ("training", "training", ""),
    ("minutes", "minutes", ".1f"),
    ("steps", "steps", ",d"),
    ("PSNR of novel\nviews, dB", "psnr", ".2f"),
    ("of the\nseeds", "seeds", ""),
    ("steps a\nsecond", "steps_per_second", ".1f"),
    ("waiting\nfor data", "data_wait", ".0%"),
]


class TrainingSettings(TypedDict):
    """Settings of `completesplat fit`, and the training that makes the stage 1 that they build on, if they do."""

    settings: list[str]
    stage1: str | None


class TrainingCurve(NamedTuple):
    """What a run logged: steps and seconds since its start where PSNR was measured, and where the speed was."""

    steps: list[int]
    seconds: list[float]
    data_wait: list[float]
    psnr: dict[int, float]

    def curve(self) -> list[dict[str, float]]:
        """PSNR by steps and seconds."""
        seconds = dict(zip(self.steps, self.seconds, strict=True))
        return [{"steps": step, "seconds": seconds[step], "psnr": value} for step, value in self.psnr.items()]

    def rate(self) -> float:
        """Steps a second in the second half."""
        half = len(self.steps) // 2 - 1
        return (self.steps[-1] - self.steps[half]) / (self.seconds[-1] - self.seconds[half])


def run(
    write: Callable[..., object],
    runs: Mapping[str, TrainingSettings],
    settings: Sequence[str],
    minutes: Annotated[float, Range(0.01)],
    points: Positive,
    probe: Annotated[int, Range(4 * INTERVAL)],
    seeds: Annotated[Sequence[Natural], Entries(1)],
    out: Path,
) -> None:
    """Train each for so long, in a process of its own; write `quality.json` and `quality.png`, print a table.

    How many steps the time allows is measured first, since learning rates fall to the end of a run. Times are of
    training steps with their waiting for data: without the start, validation, checkpoints and pictures.

    Args:
        write: (out) makes the scenes, in that folder.
        runs: by name; one that others build on stands before them.
        settings: of all runs, behind their own.
        minutes: of each run.
        points: validations of each run.
        probe: steps in which the speed is measured; the first half does not count.
        seeds: of each run.

    Raises:
        CompleteSplatError: a run failed, or builds on one that does not stand before it.
    """
    _refuse_unknown(runs)
    with TemporaryDirectory(prefix="bench_quality_", dir=out) as name:
        write(out=Path(name) / "scenes")
        train = partial(_trained, Path(name), runs, settings, minutes, points, probe)
        found = {label: [train(label, seed) for seed in seeds] for label in runs}
    curves = {label: [one.curve() for one in trainings] for label, trainings in found.items()}
    results: dict[str, Any] = {
        "machine": machine(),
        "workload": {"minutes": minutes, "settings": list(settings), "runs": dict(runs)},
        "rows": [_row(label, trainings) for label, trainings in found.items()],
        "curves": curves,
    }
    write_json(out / "quality.json", results)
    plot(curves, out / "quality.png")
    hardware = f"{results['machine']['processor']}, {results['machine']['cores']} cores"
    print_results(results, hardware, [table("What a time of training gives", COLUMNS, results["rows"])])


def _trained(
    folder: Path,
    runs: Mapping[str, TrainingSettings],
    settings: Sequence[str],
    minutes: float,
    points: int,
    probe: int,
    label: str,
    seed: int,
) -> TrainingCurve:
    """A run in `folder`, which holds the scenes and the runs before, as long as a first one of `probe` steps says."""
    given = [*runs[label]["settings"], f"data.root={folder / 'scenes'}", *settings, f"seed={seed}"]
    if runs[label]["stage1"] is not None:
        stage1 = folder / f"{runs[label]['stage1']} {seed}/checkpoints/last.ckpt"
        given.append(f"model.autoreconstructor_checkpoint={stage1}")
    with Console(stderr=True).status(f"{label}, seed {seed}"):
        rate = fit([*given, *_lasting(probe, 1)], folder / f"probe {label} {seed}").rate()
        steps = max(1, round(minutes * 60 * rate / INTERVAL / points)) * INTERVAL * points
        return fit([*given, *_lasting(steps, points)], folder / f"{label} {seed}")


def _refuse_unknown(runs: Mapping[str, TrainingSettings]) -> None:
    before: list[str] = []
    for name, one in runs.items():
        if one["stage1"] not in (None, *before):
            raise CompleteSplatError(f"runs: {name} builds on {one['stage1']!r}, which does not stand before it")
        before.append(name)


def _lasting(steps: int, points: int) -> list[str]:
    return [f"trainer.max_steps={steps}", f"trainer.val_check_interval={steps // points}"]


def fit(settings: Sequence[str], out: Path) -> TrainingCurve:
    """Train in a process of its own, and read what it logged.

    Raises:
        CompleteSplatError: it failed, with its last line.
    """
    common = ["test=false", "callbacks.pictures=null", f"trainer.log_every_n_steps={INTERVAL}"]
    command = [sys.executable, "-m", "completesplat", "fit", *settings, *common, f"out={out}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"status {done.returncode}"]
        raise CompleteSplatError(f"{out.name}: {said[-1]}")
    return logged(out)


def logged(run: Path) -> TrainingCurve:
    """What a run wrote into `metrics.csv`."""
    scenes = OmegaConf.load(run / "config.yaml").data.batch_size * INTERVAL
    with (run / "metrics.csv").open(newline="") as file:
        # The last row repeats the newest figures.
        rows = [row for row in csv.DictReader(file) if (int(row["step"]) + 1) % INTERVAL == 0]
    speeds = [row for row in rows if row.get(SPEED)]
    return TrainingCurve(
        steps=[int(row["step"]) + 1 for row in speeds],
        seconds=list(accumulate(scenes / float(row[SPEED]) for row in speeds)),
        data_wait=[float(row[WAITING]) for row in speeds],
        psnr={int(row["step"]) + 1: float(row[PSNR]) for row in rows if row.get(PSNR)},
    )


def _row(label: str, trainings: Sequence[TrainingCurve]) -> dict[str, Any]:
    """Means over seeds, of what was reached at the end."""
    ends = [one.curve()[-1] for one in trainings]
    reached = [end["psnr"] for end in ends]
    steps, seconds = fmean(end["steps"] for end in ends), fmean(end["seconds"] for end in ends)
    return {
        "training": label,
        "minutes": seconds / 60,
        "steps": round(steps),
        "psnr": fmean(reached),
        "seeds": ", ".join(f"{value:.2f}" for value in reached),
        "steps_per_second": steps / seconds,
        "data_wait": fmean(share for one in trainings for share in one.data_wait),
    }


def plot(curves: Mapping[str, Sequence[Sequence[Mapping[str, float]]]], path: Path) -> None:
    """PSNR against seconds and against steps, a line for each seed of a training."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    for panel, axis in zip(figure.subplots(1, 2, sharey=True), ("seconds", "steps"), strict=True):
        for i, (label, seeds) in enumerate(curves.items()):
            for number, curve in enumerate(seeds):
                points = [point[axis] for point in curve], [point["psnr"] for point in curve]
                panel.plot(*points, color=f"C{i}", marker=".", label=None if number else label)
        panel.set(xlabel=f"{axis} of training")
        panel.grid(alpha=0.3)
    figure.axes[0].set_ylabel("PSNR of novel views, dB")
    figure.axes[0].legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)
