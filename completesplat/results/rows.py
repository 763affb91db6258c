"""Figures of runs as rows: one for each setting over its seeds, one for each predictor of a run."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from completesplat.results.runs import Job, Run
from completesplat.results.tables import ABSENT, FORMATS, Cell, Notes

SEED = "seed"
PROPOSED = "full"
"""The unchanged method among the ablations: the last row, as in the paper."""


def labels(jobs: Sequence[Job]) -> Callable[[Job], str]:
    """Names jobs by the overrides that are not equal in all of them, the seed apart.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job that
    differs in nothing bears the name of its experiment, or `all`.
    """
    described = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in described for key in overrides)
    differing = [key for key in keys if len({overrides.get(key) for overrides in described}) > 1]
    # A group fills a mapping of the configuration, or acts on all of it and leaves nothing under its own name.
    settings = {key for job in jobs for key, value in job.config.items() if not isinstance(value, dict)}

    def label(job: Job) -> str:
        parts = []
        for key in differing:
            if key in job.overrides and key != SEED:
                bare = "." not in key and "@" not in key and key not in settings
                parts.append(job.overrides[key] if bare else f"{key}={job.overrides[key]}")
        return ", ".join(parts) or job.overrides.get("experiment", "all")

    return label


def setting(job: Job) -> frozenset[tuple[str, str]]:
    """What jobs share that differ in nothing but the seed."""
    return frozenset((key, value) for key, value in job.overrides.items() if key != SEED)


def order(label: str) -> list[tuple[bool, str]]:
    """A key that sorts labels alphabetically, part by part, the unchanged method last."""
    return [(part == PROPOSED, part) for part in label.split(", ")]


MODEL = "model"
UPPER_BOUND = "upper_bound"
"""Marks jobs, and their rows, whose model has seen the views that it is scored on."""
IDENTITY = ["ablation", "seeds", "scenes", "steps", UPPER_BOUND]
AGREEMENT = 1e-4
"""How far, relatively, a naive predictor's scores may lie apart in two jobs before it is said."""


def rows(finished: Sequence[Job], label: Callable[[Job], str]) -> list[dict[str, Any]]:
    """One row for each setting, sorted by label, and the naive predictors below, which have no seeds.

    Each row has the columns `IDENTITY` and `NAME_mean`, `NAME_deviation` for every metric NAME of the model, such as
    `full_novel_psnr`; the deviation is the sample's, over seeds. What was not measured in all jobs of a row is None
    there: a mean over fewer seeds than the row names would mislead.
    """
    names = list(dict.fromkeys(name for job in finished for name in scores(job, MODEL)))
    groups: dict[frozenset[tuple[str, str]], list[Job]] = {}
    for job in finished:
        groups.setdefault(setting(job), []).append(job)
    ours = [_row(label(jobs[0]), jobs, names) for jobs in groups.values()]
    naive = dict.fromkeys(predictor for job in finished for predictor in job.test if predictor != MODEL)
    return [*sorted(ours, key=lambda row: order(row["ablation"])), *(_naive(p, finished, names) for p in naive)]


def scores(job: Job, predictor: str) -> dict[str, float]:
    """The test scores of a predictor, by `region_view_metric`."""
    return dict(_flat(job.test.get(predictor, {})))


def disagreeing(finished: Sequence[Job]) -> list[str]:
    """The naive predictors that score differently in different jobs, which should all be tested on the same scenes."""
    naive = dict.fromkeys(predictor for job in finished for predictor in job.test if predictor != MODEL)
    found = []
    for predictor in naive:
        tables = [scores(job, predictor) for job in finished]
        names = {name for table in tables for name in table}
        if not all(_agree([table[name] for table in tables if name in table]) for name in names):
            found.append(predictor)
    return found


def _flat(entry: dict[str, Any]) -> Iterator[tuple[str, float]]:
    for region, views in entry.items():
        if isinstance(views, dict):
            for view, metrics in views.items():
                if isinstance(metrics, dict):  # the seconds of a sequence are not
                    yield from ((f"{region}_{view}_{metric}", value) for metric, value in metrics.items())


def _row(label: str, jobs: Sequence[Job], names: Sequence[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"ablation": label, "seeds": len(jobs), "scenes": _scenes(jobs, MODEL)}
    row["steps"] = _one_or_all(job.metrics["steps"] for job in jobs if job.metrics)
    row[UPPER_BOUND] = any(job.metrics and job.metrics.get(UPPER_BOUND) for job in jobs)
    tables = [scores(job, MODEL) for job in jobs]
    for name in names:
        complete = all(name in table for table in tables)
        values = [table[name] for table in tables] if complete else []
        with np.errstate(invalid="ignore"):  # of an infinite PSNR there is no deviation
            row[f"{name}_mean"] = float(np.mean(values)) if values else None
            row[f"{name}_deviation"] = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return row


def _naive(predictor: str, jobs: Sequence[Job], names: Sequence[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"ablation": predictor, "seeds": None, "scenes": _scenes(jobs, predictor), "steps": None}
    row[UPPER_BOUND] = False
    tables = [scores(job, predictor) for job in jobs]
    for name in names:
        values = [table[name] for table in tables if name in table]
        agreed = values[0] if values and _agree(values) else None
        mean = float(np.mean(values)) if values else None
        row |= {f"{name}_mean": mean if agreed is None else agreed, f"{name}_deviation": None}
    return row


def _agree(values: Sequence[float]) -> bool:
    return np.allclose(values, values[0], rtol=AGREEMENT, atol=0, equal_nan=True)


def _scenes(jobs: Sequence[Job], predictor: str) -> int | str | None:
    return _one_or_all(job.test[predictor]["scenes"] for job in jobs if predictor in job.test)


def _one_or_all(values: Iterator[int]) -> int | str | None:
    """The number on which all agree; `40/38` where they do not."""
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else "/".join(map(str, different)) or None


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
