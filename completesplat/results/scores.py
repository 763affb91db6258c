"""Scores as rows of tables: one row for each setting of a sweep, or for each predictor of a run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from completesplat.results.runs import SEED, Job, Result
from completesplat.results.tables import ABSENT, FORMATS, Cell, Heading, Notes, by_name, marks

MODEL, BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K = "model", "best_of_k", "best_of_k_by_metric", "mean_of_k"
PROPOSED = "full"  # the unchanged method among the ablations: the last row, as in the paper
UPPER_BOUND = "upper_bound"  # marks jobs and rows whose model has seen the views that it is scored on
IDENTITY = ["ablation", "seeds", "scenes", "steps", UPPER_BOUND]
AGREEMENT = 1e-4  # relative difference between a naive predictor's scores in two jobs that the summary ignores
ALWAYS = ["full_novel_psnr", "full_novel_ssim", "object_novel_psnr", "object_novel_ssim", "full_reference_psnr"]
WHERE_MEASURED = ["full_novel_lpips", "full_novel_fid", "full_novel_kid"]  # scores in the table of a sweep

COST = {"inference": "inference", "rendering": "rendering"}
LEADING = {"method": "method", "speed": "rendering speed", **COST, "scenes": "scenes", "resolution": "pixels"}
"""The columns before the scores, and their headings."""
OURS = "completesplat: "  # not "ours", because the paper gives its rows that name
DESCRIBED = ["name", "data_set", "subset", "split", "image_size", "resolution", "crop", "precision", "scenes"]
DESCRIBED += ["scenes_listed", "skipped", "views", "protocol_views", "scene_list", "samples", "criterion", "seed"]
DESCRIBED += ["sampler", "steps", "skip_weight", "guidance_weight", "ema", "commit"]
"""Entries of the protocol that the note on a row states."""


def rows(finished: Sequence[Job]) -> list[dict[str, Any]]:
    """Return a row for each setting, sorted by label, and then the naive predictors, which have no seeds.

    Each row has the columns `IDENTITY` and `NAME_mean`, `NAME_deviation` for every metric NAME of the model, such as
    `full_novel_psnr`; the latter is the sample standard deviation over seeds. A metric that was not measured in all
    jobs of a row is None, because a mean over fewer seeds than the row states would mislead.
    """
    names = list(dict.fromkeys(name for job in finished for name in _scores(job, MODEL)))
    settings: dict[frozenset[tuple[str, str]], list[Job]] = {}
    for job in finished:
        shared = frozenset((key, value) for key, value in job.overrides.items() if key != SEED)
        settings.setdefault(shared, []).append(job)

    def order(row: dict[str, Any]) -> list[tuple[bool, str]]:  # alphabetical by part, the unchanged method last
        return [(part == PROPOSED, part) for part in row["ablation"].split(", ")]

    ours = sorted((_row(jobs, names) for jobs in settings.values()), key=order)
    return [*ours, *(_naive_row(predictor, finished, names) for predictor in _naive_predictors(finished))]


def disagreeing(finished: Sequence[Job]) -> list[str]:
    """Return the naive predictors whose scores differ between jobs, which should all have the same test scenes."""
    predictors = []
    for predictor in _naive_predictors(finished):
        tables = [_scores(job, predictor) for job in finished]
        names = {name for table in tables for name in table}
        if not all(_agree([table[name] for table in tables if name in table]) for name in names):
            predictors.append(predictor)
    return predictors


def _naive_predictors(jobs: Sequence[Job]) -> list[str]:
    return list(dict.fromkeys(predictor for job in jobs for predictor in job.test if predictor != MODEL))


def _scores(job: Job, predictor: str) -> dict[str, float]:
    return by_name(job.test.get(predictor, {}))


def _row(jobs: Sequence[Job], names: Sequence[str]) -> dict[str, Any]:
    measured = [job.metrics for job in jobs if job.metrics]
    scenes = _one_or_all(job.test[MODEL]["scenes"] for job in jobs if MODEL in job.test)
    row: dict[str, Any] = {"ablation": jobs[0].label, "seeds": len(jobs), "scenes": scenes}
    row["steps"] = _one_or_all(metrics["steps"] for metrics in measured)
    row[UPPER_BOUND] = any(metrics.get(UPPER_BOUND) for metrics in measured)
    tables = [_scores(job, MODEL) for job in jobs]
    for name in names:
        complete = all(name in table for table in tables)
        values = [table[name] for table in tables] if complete else []
        with np.errstate(invalid="ignore"):  # an infinite PSNR has no standard deviation
            row[f"{name}_mean"] = float(np.mean(values)) if values else None
            row[f"{name}_deviation"] = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return row


def _naive_row(predictor: str, jobs: Sequence[Job], names: Sequence[str]) -> dict[str, Any]:
    scenes = _one_or_all(job.test[predictor]["scenes"] for job in jobs if predictor in job.test)
    row: dict[str, Any] = dict(zip(IDENTITY, (predictor, None, scenes, None, False), strict=True))
    tables = [_scores(job, predictor) for job in jobs]
    for name in names:
        values = [table[name] for table in tables if name in table]
        mean = None if not values else values[0] if _agree(values) else float(np.mean(values))
        row |= {f"{name}_mean": mean, f"{name}_deviation": None}
    return row


def _agree(values: Sequence[float]) -> bool:
    return np.allclose(values, values[0], rtol=AGREEMENT, atol=0, equal_nan=True)


def _one_or_all(values: Iterable[int]) -> int | str | None:
    """Return the number if all are equal, else all different ones, such as `40/38`."""
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else "/".join(map(str, different)) or None


def headline(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the names of the metrics that a table of rows shows."""
    return [*ALWAYS, *(name for name in WHERE_MEASURED if any(row.get(f"{name}_mean") is not None for row in rows))]


def figures(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> list[list[Cell]]:
    """Return a cell for each row and metric: `21.34 ± 0.12`, best and second best marked, empty if not measured.

    Rows without seeds (the naive predictors) and upper bounds do not compete. One seed has no standard deviation.
    """
    competing = [row["seeds"] is not None and not row[UPPER_BOUND] for row in rows]
    columns = []
    for name in names:
        means = [row.get(f"{name}_mean") for row in rows]
        form, texts = FORMATS[name.rpartition("_")[2]], []
        for row, mean in zip(rows, means, strict=True):
            deviation = row.get(f"{name}_deviation")
            after = "" if deviation is None else f" ± {deviation:{form}}"
            texts.append("" if mean is None else f"{mean:{form}}{after}")
        columns.append([Cell(*cell) for cell in zip(texts, marks(means, competing, name), means, strict=True)])
    return [list(cells) for cells in zip(*columns, strict=True)]


@dataclass(frozen=True)
class Entry:
    """Scores of one predictor in one run."""

    run: Result
    predictor: str
    scores: dict[str, Any]

    @property
    def own(self) -> bool:
        """Whether the predictor is the run's model rather than a naive one."""
        return self.predictor in (MODEL, BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K)

    @property
    def upper_bound(self) -> bool:
        """Whether the predictor has seen the views that it is scored on."""
        return bool(self.scores.get(UPPER_BOUND))

    def method(self, notes: Notes) -> Cell:
        """Return the method, which of its samples were scored, and the number of the note on how they were measured."""
        protocol, label = self.run.protocol, self.predictor.replace("_", " ")
        if self.own:
            samples = protocol.get("samples", 1)
            oracle, criterion = f", {samples}-best oracle by", str(protocol.get("criterion")).upper()
            kinds = {BEST_OF_K: f"{oracle} {criterion}", BEST_BY_METRIC: f"{oracle} each metric"}
            kinds[MEAN_OF_K] = f", mean of {samples} samples"
            kinds[MODEL] = ", single sample" if protocol.get("sampler") else ""
            label = f"{protocol.get('method', 'model')}{kinds[self.predictor]}"
            label += " (upper bound)" if self.upper_bound else ""
        return Cell(f"{OURS}{label} [{notes.number(described(self.run))}]")

    def value(self, name: str) -> float | None:
        """Return the score named `REGION_VIEW_METRIC`; None if it was not measured."""
        region, view, metric = name.split("_")
        value = self.scores.get(region, {}).get(view, {}).get(metric)
        return float(value) if isinstance(value, int | float) else None

    def cell(self, name: str, notes: Notes) -> Cell:
        """Return a cell with the score, or with the number of the note on why there is none."""
        value, metric = self.value(name), name.rpartition("_")[2]
        if value is not None:
            return Cell(format(value, FORMATS[metric]), value=value)
        reasons = self.run.protocol.get("missing") or {}
        return notes.missing(f"{metric}: {reasons.get(metric, f'not measured for {self.predictor}')}")

    def leading(self, notes: Notes) -> dict[str, Cell]:
        """Return the cells before the scores, by the keys of `LEADING`; unknown values are `ABSENT`."""
        seconds, protocol = self.scores.get("seconds") or {}, self.run.protocol
        cells = {"method": self.method(notes), "speed": Cell(ABSENT)}
        cells |= {part: time_cell(seconds.get(part)) for part in COST}
        return cells | {key: Cell(str(protocol[key])) for key in ("scenes", "resolution")}


def leading_headings(keys: Iterable[str]) -> list[Heading]:
    """Return headings for some keys of `LEADING`."""
    named = [(key, "time per sequence" if key in COST else "") for key in keys]
    return [Heading(LEADING[key], group, key not in ("method", "speed")) for key, group in named]


def entries(runs: Sequence[Result]) -> list[Entry]:
    """Return all entries of all runs, in the order of their files."""
    return [Entry(run, predictor, scores) for run in runs for predictor, scores in run.entries.items()]


def time_cell(seconds: float | None) -> Cell:
    """Return a time in the paper's units: `15.7 ms`, `2.7 sec`, `4.1 min`."""
    if seconds is None:
        return Cell(ABSENT)
    if seconds < 1:
        text = f"{1000 * seconds:.1f} ms"
    else:
        text = f"{seconds:.1f} sec" if seconds < 60 else f"{seconds / 60:.1f} min"
    return Cell(text, value=float(seconds))


def described(run: Result) -> str:
    """Describe in one line how a run was measured."""
    protocol = run.protocol
    known = {key: protocol[key] for key in DESCRIBED if protocol.get(key) is not None}
    parts = [f"{key} {len(value) if isinstance(value, list) else value}" for key, value in known.items()]
    checkpoint = protocol.get("checkpoint") or {}
    parts += [f"checkpoint {key} {str(checkpoint[key])[:12]}" for key in ("step", "sha256") if checkpoint.get(key)]
    fingerprint, machine = protocol.get("data_fingerprint"), protocol.get("machine") or {}
    parts += [f"data {str(fingerprint)[:12]}"] if fingerprint else []
    parts += [f"on {machine.get('gpu') or machine.get('processor')}, {machine.get('date')}"] if machine else []
    return f"{run.name}: {', '.join(parts)}."
