"""The paper's ablations beside those of our sweeps."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from completesplat.reports.comparison.beside import shown
from completesplat.reports.comparison.cells import ABSENT, LEGEND, Cell, Heading, Notes, Row, Table
from completesplat.reports.comparison.entries import MODEL, duration
from completesplat.reports.comparison.own import alike, protocol_said
from completesplat.reports.published.figures import Figure, PublishedTable, source
from completesplat.reports.sweeps.headline import figure, marks, metric
from completesplat.reports.sweeps.jobs import Job, collect
from completesplat.reports.sweeps.labels import labels
from completesplat.reports.sweeps.rows import rows

COLUMNS = [f"full_novel_{name}" for name in ("psnr", "ssim", "lpips", "fid", "kid")]
APART = (
    "The published columns are by the paper's protocol, ours by the one stated here: figures compare within the "
    "columns of one heading only."
)


def published_ablations(table: PublishedTable) -> Table:
    """The paper's figures alone."""
    headings = [Heading("setting", figures=False), *_headings(table)]
    body = [Row("paper", [shown(cell) for cell in row]) for row in table.rows]
    return Table(table.name, f"{table.place}: {table.title}", headings, body, [_said(table), LEGEND])


def is_ablation(folder: Path, table: PublishedTable) -> bool:
    """Whether a sweep's folder holds tested jobs that are rows of the paper's table."""
    jobs = collect(folder)
    label = labels(jobs)
    return any(_option(label(job), table) for job in jobs if job.protocol)


def sweep_beside(table: PublishedTable, folder: Path, name: str) -> list[Table]:
    """For each protocol by which jobs of a sweep were tested: mean and deviation over seeds beside the paper's rows."""
    jobs = collect(folder)
    label = labels(jobs)
    groups: dict[str, list[Job]] = {}
    for job in jobs:
        if job.protocol:
            groups.setdefault(alike(job.protocol), []).append(job)
    return [_beside(table, rows(group, label), [(label(job), job) for job in group], name) for group in groups.values()]


def _beside(
    table: PublishedTable, found: Sequence[dict[str, Any]], jobs: Sequence[tuple[str, Job]], name: str
) -> Table:
    protocol, notes = jobs[0][1].protocol, Notes()
    printed = {row[0].text: row for row in table.rows}
    order = [*printed, ""]
    own = sorted(found, key=lambda row: order.index(_option(row["ablation"], table)))
    marked = {column: marks(own, column) for column in COLUMNS}
    reasons = protocol.get("missing") or {}
    body = []
    for index, row in enumerate(own):
        published = printed.get(_option(row["ablation"], table), [Figure(ABSENT, frozenset())] * len(table.columns))
        same = [job for label, job in jobs if label == row["ablation"]]
        cells = [Cell(row["ablation"]), *map(shown, published), *_identity(row), *_times(same)]
        for column in COLUMNS:
            text, metric_key = figure(row, column), column.rpartition("_")[2]
            reason = f"{metric_key}: {reasons.get(metric_key, 'not measured in all jobs of this row')}"
            mean = row.get(f"{column}_mean")
            cells.append(Cell(text, marked[column][index], mean) if text else notes.missing(reason))
        body.append(Row("naive" if row["seeds"] is None else "ours", cells))
    body += [_only_published(row, table) for row in table.rows if not _ours(row, own, table)]
    headings = [Heading("setting", figures=False), Heading("row of the paper", "published", False)]
    headings += _headings(table)
    group = f"ours: {protocol['data_set']}, {protocol['resolution']} pixels"
    headings += [Heading(text, group) for text in ("seeds", "scenes", "inference", "rendering")]
    headings += [Heading(metric(column), group) for column in COLUMNS]
    remarks = [_said(table), f"Ours: {name}, mean ± sample deviation over seeds. {protocol_said(protocol)}"]
    title = f"{table.place}: ablations beside ours on {protocol['data_set']}"
    return Table(f"ablations_{name}", title, headings, body, [*remarks, APART, LEGEND], notes)


def _option(label: str, table: PublishedTable) -> str:
    """The paper's row that a row of ours stands for; empty if there is none."""
    return next((table.options[part] for part in label.split(", ") if part in table.options), "")


def _ours(row: Sequence[Figure], own: Iterable[dict[str, Any]], table: PublishedTable) -> bool:
    return any(_option(other["ablation"], table) == row[0].text for other in own)


def _only_published(row: Sequence[Figure], table: PublishedTable) -> Row:
    empty = [Cell(ABSENT)] * (4 + len(COLUMNS))
    return Row("paper", [Cell(ABSENT), *map(shown, row), *empty])


def _headings(table: PublishedTable) -> list[Heading]:
    """Of the published figures."""
    return [Heading(column.heading, "published") for column in table.columns[1:]]


def _said(table: PublishedTable) -> str:
    return f"Published figures: {source()}, {table.place}; best in bold and second best underlined as printed."


def _identity(row: dict[str, Any]) -> list[Cell]:
    return [Cell(ABSENT if row[key] is None else str(row[key])) for key in ("seeds", "scenes")]


def _times(jobs: Sequence[Job]) -> list[Cell]:
    """Of one sequence, mean over jobs."""
    found = [job.test.get(MODEL, {}).get("seconds") or {} for job in jobs]
    cells = []
    for part in ("inference", "rendering"):
        seconds = [entry[part] for entry in found if entry.get(part) is not None]
        mean = sum(seconds) / len(seconds) if seconds else None
        cells.append(Cell(ABSENT) if mean is None else Cell(duration(mean), value=mean))
    return cells
