"""The numbers of a sweep: one row for each setting, over its seeds, and one for each naive predictor."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from completesplat.reports.sweeps.jobs import Job
from completesplat.reports.sweeps.labels import order, setting

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
