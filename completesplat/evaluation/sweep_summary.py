"""Summary of a sweep: a table of its settings over seeds, as in the paper."""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode

from completesplat.evaluation import table_writers, tables
from completesplat.evaluation.provenance import machine, shell_command
from completesplat.evaluation.records import MODEL, UPPER_BOUND, FlatScores, Record
from completesplat.evaluation.score_tables import Entry, formats_of, group_by_protocol, score_rows
from completesplat.evaluation.sweep_jobs import SEED, VALIDATION, Job, collect, not_started
from completesplat.wording import printable

# Hydra imports this file for every run, even to print the help. So torch and rich are imported when a job has ended.
log = logging.getLogger(__name__)

CAPTION = "Mean ± sample standard deviation over seeds; PSNR in dB."
TEST_NOTE = f"The best of our rows is in bold, the second best underlined. {tables.SSIM_NOTE}"
OF_VALIDATION = "validation, not a test"
VALIDATION_NOTE = (
    "Jobs without a test have the last figures of their validation, on a fixed part of the validation set; "
    "they are no scores of a test and are not ranked."
)
MOST_NAMED = 20  # jobs in a remark
PROPOSED = "full"  # the unchanged method among the ablations: the last row, as in the paper
IDENTITY = ["ablation", "seeds", "scenes", "steps", UPPER_BOUND, "unchanged", "bad_steps"]


class SweepSummary(Callback):
    """Hydra callback that rewrites a sweep's summary after every job and prints it after the last.

    Thus a sweep that is killed, or whose jobs fail, has a summary too, although hydra does not call `on_multirun_end`
    for it. If a summary cannot be written, a warning states the reason, and the sweep continues.
    """

    def on_job_end(self, config: Any, job_return: JobReturn, **kwargs: object) -> None:
        """Rewrite the summary after a job of a sweep, whether it finished or failed."""
        if config.hydra.mode == RunMode.MULTIRUN:
            _summarize(config, last=False)

    def on_multirun_end(self, config: Any, **kwargs: object) -> None:
        """Write the summary again, because jobs that end together may miss each other. Print it and its path."""
        _summarize(config, last=True)


def _summarize(config: Any, last: bool) -> None:
    try:
        folder = Path(config.hydra.sweep.dir)
        table = write_summary(folder)
        if last:
            table_writers.show(table, width=160)
            print(folder / "summary.md")
    except Exception as error:  # no error of a summary may stop the remaining jobs
        log.warning("no summary of the sweep: %s: %s", type(error).__name__, error)


def sweep_rows(finished: Sequence[Job]) -> list[Entry]:
    """Return means over seeds for each setting, sorted by label, and then for the naive predictors.

    A score that was not measured in all jobs is left out, because a mean over fewer seeds than the row states would
    mislead. A setting without a test has the means of its last validation, under names that no test has
    (`val/psnr_novel`).
    """
    rows = [_setting_row(jobs) for jobs in _jobs_by_setting(finished)]
    rows.sort(key=_order)
    naive = dict.fromkeys(predictor for job in finished for predictor in job.test if predictor != MODEL)
    for name in naive:
        rows.append(_row(name, [job for job in finished if name in job.test], name))
    return rows


def _jobs_by_setting(finished: Sequence[Job]) -> list[list[Job]]:
    """Return the jobs of each setting, one for each seed."""
    settings: dict[frozenset[tuple[str, str]], dict[object, Job]] = {}
    for job in finished:
        shared = frozenset((key, value) for key, value in job.overrides.items() if key != SEED)
        # An extended sweep may repeat the default seed as seed=N.
        seed = job.overrides.get(SEED, str(job.config.get(SEED)))
        settings.setdefault(shared, {})[seed] = job
    return [list(by_seed.values()) for by_seed in settings.values()]


def _order(row: Entry) -> list[tuple[bool, str]]:
    """Return a key that sorts labels alphabetically by their parts, the unchanged method last."""
    return [(part == PROPOSED, part) for part in row.label.split(", ")]


def _row(label: str, jobs: Sequence[Job], predictor: str) -> Entry:
    """Return the means of a predictor over jobs."""
    tested = [job.test.get(predictor, {}) for job in jobs]
    return Entry(
        label,
        {name: fmean(values) for name, values in _shared_values(jobs, predictor).items()},
        _common(int(scores["scenes"]) for scores in tested if scores),
        predictor,
        upper_bound=any(scores.get(UPPER_BOUND) for scores in tested),
        protocol=jobs[0].protocol,
    )


def _setting_row(jobs: Sequence[Job]) -> Entry:
    """Return the row of a setting: means and deviations over its seeds."""
    deviations = {}
    if len(jobs) > 1:
        deviations = {name: _deviation(values) for name, values in _shared_values(jobs, MODEL).items()}
    return replace(
        _row(jobs[0].label, jobs, MODEL),
        seeds=len(jobs),
        steps=_common(job.steps for job in jobs),
        deviations=deviations,
        unchanged=all(job.record.get("unchanged", False) for job in jobs),
        bad_steps=sum(job.bad_steps for job in jobs),
    )


def _shared_values(jobs: Sequence[Job], predictor: str) -> dict[str, list[float]]:
    """Return a value for each job of each score that all jobs have; figures of validation, if no job has a test."""
    if any(job.test for job in jobs):
        by_job = [_scores_of_views(job.test.get(predictor, {})) for job in jobs]
    else:
        by_job = [job.validation for job in jobs]
    shared = set.intersection(*map(set, by_job))
    return {name: [scores[name] for scores in by_job] for name in by_job[0] if name in shared}


def _scores_of_views(scores: FlatScores) -> FlatScores:
    """Return the scores of images, without facts of the run such as its time."""
    return {name: value for name, value in scores.items() if "_novel_" in name or "_reference_" in name}


def _deviation(values: Sequence[float]) -> float:
    """Return the sample standard deviation, or NaN if a value is infinite."""
    return stdev(values) if all(map(math.isfinite, values)) else math.nan


def _common(values: Iterable[int]) -> int | str | None:
    """Return the number if all are equal, else all different ones, such as `40/38`."""
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else "/".join(map(str, different)) or None


def summarize(*folders: Path) -> tuple[list[Entry], tables.Table]:
    """Return rows and table of the jobs in a sweep's folder, or in its parts on several machines, finished or not.

    One seed has no standard deviation.
    """
    jobs = collect(*folders)
    finished = [job for job in jobs if job.finished]
    alike = len(group_by_protocol((job, job.protocol) for job in finished if job.protocol)) < 2
    rows = sweep_rows(finished)
    if not alike:
        rows = [row for row in rows if row.seeds is not None]
    headings, body = _columns(rows, alike)
    waiting: list[str] = []
    for folder in folders:
        waiting += not_started(folder, jobs)
    remarks = [
        *_table_remarks(rows, alike),
        *_progress_remarks(jobs, waiting),
        *_program_remarks([job.record for job in jobs if job.record]),
    ]
    scenes = "Test scenes" if _tested(rows) or not _validated(rows) else "Validation scenes"
    return rows, tables.Table("summary", f"{scenes}, mean ± deviation over seeds", headings, body, remarks)


def _columns(rows: Sequence[Entry], alike: bool) -> tuple[list[tables.Heading], list[tables.TableRow]]:
    """Return headings and rows of cells: labels, then scores of tests, then figures of validation."""
    formats = formats_of(rows)
    tested = _tested(rows)
    validated = _validated(rows)
    headings = [tables.Heading("ablation", figures=False), tables.Heading("seeds"), tables.Heading("scenes")]
    for name in tested:
        headings.append(tables.score_heading(name, formats[tables.metric_of(name)]))
    for name in validated:
        headings.append(tables.Heading(name.removeprefix(VALIDATION), OF_VALIDATION))
    columns = [(name, None) for name in tested]
    body = score_rows(rows, ("method", "seeds", "scenes"), columns, tables.Notes(), marked=alike)
    for row, line in zip(rows, body, strict=True):
        line.cells.extend(_validation_cell(row, name) for name in validated)
    return headings, body


def _tested(rows: Sequence[Entry]) -> list[str]:
    """Return the names of the scores of tests that the table shows."""
    names = {name for row in rows for name in row.scores}
    return [name for name in tables.shown_scores(formats_of(rows)) if name in names]


def _validated(rows: Sequence[Entry]) -> list[str]:
    """Return the names of the figures of validation that a row has."""
    names = {name for row in rows for name in row.scores}
    return sorted(name for name in names if name.startswith(VALIDATION))


def _validation_cell(row: Entry, name: str) -> tables.Cell:
    """Return a cell with a figure of validation, which is not ranked."""
    value = row.scores.get(name)
    if value is None:
        return tables.Cell("")
    text = f"{value:.4g}"
    if name in row.deviations:
        text += f" ± {row.deviations[name]:.2g}"
    return tables.Cell(text, value=value)


def _table_remarks(rows: Sequence[Entry], alike: bool) -> list[str]:
    """Return remarks on what the table shows."""
    if not rows:
        return ["No job of this sweep has finished."]
    remarks = [f"{CAPTION} {TEST_NOTE}" if _tested(rows) else CAPTION]
    if _validated(rows):
        remarks.append(VALIDATION_NOTE)
    if not alike:
        remarks.append("Jobs were tested differently (data, resolution, scenes), so their scores cannot be compared.")
    for row in rows:
        if row.upper_bound:
            remarks.append(f"{row.label} has seen the views that it is scored on.")
    return remarks


def _progress_remarks(jobs: Sequence[Job], waiting: Sequence[str]) -> list[str]:
    diverged = [printable(job.name) for job in jobs if job.record.get("diverged") and not job.finished]
    unfinished = [printable(job.name) for job in jobs if not job.finished and not job.record.get("diverged")]
    finished = sum(job.finished for job in jobs)
    remarks = [f"{finished} of {len(jobs) + len(waiting)} jobs have finished."]
    for what, names in (("Diverged", diverged), ("Not finished", unfinished), ("Not started", waiting)):
        if names:
            more = f"; and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
            remarks.append(f"{what}: {'; '.join(names[:MOST_NAMED])}{more}.")
    return remarks


def _program_remarks(records: Sequence[Record]) -> list[str]:
    remarks = []
    commits = list(dict.fromkeys(record["commit"] or "unknown" for record in records))
    if set(commits) - {"unknown"}:
        remarks.append(f"Commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}.")
    here = machine()
    gpu = f", {here['gpu']}" if "gpu" in here else ""
    hardware = f"{here['processor']}, {here['cores']} cores{gpu}"
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    remarks.append(f"Summary of {here['date']}, made on {hardware}, {software}.")
    for command in dict.fromkeys(shell_command(record["command"]) for record in records):
        remarks.append(f"Command: {command}")
    return remarks


def write_summary(folder: Path, *parts: Path) -> tables.Table:
    """Write `summary.csv` (all metrics), `summary.md` and `summary.tex` and return the table.

    `parts` are the folders of one sweep on several machines; the files then cover all of them.
    """
    rows, table = summarize(*(parts or [folder]))
    names = list(dict.fromkeys(name for row in rows for name in row.scores))
    header = list(IDENTITY)
    for name in names:
        header += [f"{name}_mean", f"{name}_deviation"]
    lines = []
    for row in rows:
        line: list[object] = [
            row.label,
            row.seeds,
            row.scenes,
            row.steps,
            row.upper_bound,
            row.unchanged,
            row.bad_steps,
        ]
        for name in names:
            line += [row.scores.get(name), row.deviations.get(name)]
        lines.append(line)
    table_writers.write_csv(folder / "summary.csv", header, lines)
    table_writers.write_documents([table], folder / "summary")
    return table
