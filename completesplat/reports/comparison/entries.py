"""One predictor's scores in one run, as a row of a table needs them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from completesplat.reports.comparison.cells import ABSENT, Cell, Notes
from completesplat.reports.comparison.runs import Run
from completesplat.reports.sweeps.headline import FORMATS

MODEL, BEST_OF_K, MEAN_OF_K = "model", "best_of_k", "mean_of_k"
OURS = "completesplat: "
"""Not "ours": so the paper calls its own rows."""
DESCRIBED = [
    *(
        "name",
        "data_set",
        "subset",
        "split",
        "image_size",
        "resolution",
        "crop",
        "precision",
        "scenes",
        "scenes_listed",
        "skipped",
        "views",
        "protocol_views",
        "samples",
        "criterion",
    ),
    *("seed", "sampler", "steps", "skip_weight", "guidance_weight", "ema", "commit"),
]
"""Of a protocol, for the note on a row."""


@dataclass(frozen=True)
class Entry:
    """What one predictor scored in one run."""

    run: Run
    predictor: str
    scores: dict[str, Any]

    @property
    def own(self) -> bool:
        """Whether it is the run's model, and no naive predictor."""
        return self.predictor in (MODEL, BEST_OF_K, MEAN_OF_K)

    @property
    def upper_bound(self) -> bool:
        """Whether it has seen the views that it is scored on."""
        return bool(self.scores.get("upper_bound"))

    def label(self) -> str:
        """The method, and what of its samples."""
        if not self.own:
            return OURS + self.predictor.replace("_", " ")
        protocol = self.run.protocol
        method, samples = str(protocol.get("method", "model")), protocol.get("samples", 1)
        kinds = {
            BEST_OF_K: f", {samples}-best oracle",
            MEAN_OF_K: f", mean of {samples} samples",
            MODEL: ", single sample" if protocol.get("sampler") else "",
        }
        return OURS + method + kinds[self.predictor] + (" (upper bound)" if self.upper_bound else "")

    def value(self, region: str, view: str, metric: str) -> float | None:
        """None if it was not measured."""
        value = self.scores.get(region, {}).get(view, {}).get(metric)
        return float(value) if isinstance(value, int | float) else None

    def cell(self, region: str, view: str, metric: str, notes: Notes) -> Cell:
        """The score, or why there is none."""
        value = self.value(region, view, metric)
        if value is not None:
            return Cell(format(value, FORMATS[metric]), value=value)
        reasons = self.run.protocol.get("missing") or {}
        return notes.missing(f"{metric}: {reasons.get(metric, f'not measured for {self.predictor}')}")

    def time(self, part: str) -> Cell:
        """Of one sequence: `inference` or `rendering`."""
        seconds = (self.scores.get("seconds") or {}).get(part)
        return Cell(ABSENT) if seconds is None else Cell(duration(seconds), value=float(seconds))


def entries(runs: Sequence[Run]) -> list[Entry]:
    """Of all runs, in the order of their files."""
    return [Entry(run, predictor, scores) for run in runs for predictor, scores in run.entries.items()]


def duration(seconds: float) -> str:
    """In the paper's units: `15.7 ms`, `2.7 sec`, `4.1 min`."""
    if seconds < 1:
        return f"{1000 * seconds:.1f} ms"
    return f"{seconds:.1f} sec" if seconds < 60 else f"{seconds / 60:.1f} min"


def described(run: Run) -> str:
    """How a run was measured, in one line."""
    protocol = run.protocol
    said = [f"{key} {_counted(protocol[key])}" for key in DESCRIBED if protocol.get(key) is not None]
    checkpoint = protocol.get("checkpoint") or {}
    said += [f"checkpoint {key} {str(checkpoint[key])[:12]}" for key in ("step", "sha256") if checkpoint.get(key)]
    fingerprint, machine = protocol.get("data_fingerprint"), protocol.get("machine") or {}
    said += [f"data {str(fingerprint)[:12]}"] if fingerprint else []
    said += [f"on {machine.get('gpu') or machine.get('processor')}, {machine.get('date')}"] if machine else []
    return f"{run.name}: {', '.join(said)}."


def _counted(value: Any) -> Any:
    """Of names, how many they are."""
    return len(value) if isinstance(value, list) else value
