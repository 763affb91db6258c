"""Tables of the paper, with our runs beside them if they were measured by the same protocol."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.results.own import alike, mode_tables, own_tables, protocol_said
from completesplat.results.runs import HOW, MODES, SCORES, Job, RunTree, collect
from completesplat.results.scores import (
    BEST_BY_METRIC,
    BEST_OF_K,
    COST,
    LEADING,
    MODEL,
    Entry,
    entries,
    figures,
    leading_headings,
    rows,
    time_cell,
)
from completesplat.results.tables import (
    ABSENT,
    BEST,
    BLANK,
    LEGEND,
    SECOND,
    UNMARKED,
    Cell,
    Heading,
    Notes,
    Table,
    TableRow,
    metric,
)

FILE = Path(__file__).with_name("figures.yaml")
MARKS = ("best", "second", "dagger", "star")
METRICS = ("psnr", "lpips", "fid", "kid")

SIGNS = {"dagger": "†", "star": "★"}
VIEWS = (
    "The paper names both reference and novel views in its protocol and does not say how it weighs them; "
    "our rows are of novel views."
)
COLUMNS = [f"full_novel_{name}" for name in ("psnr", "ssim", "lpips", "fid", "kid")]
APART = (
    "The published columns are by the paper's protocol, ours by the one stated here: figures compare within the "
    "columns of one heading only."
)


@dataclass(frozen=True)
class PrintedCell:
    """Cell as printed, with its marks (of `MARKS`)."""

    text: str
    marks: frozenset[str]


@dataclass(frozen=True)
class PrintedColumn:
    """Column as printed: joined levels of its heading; a key of `LEADING` or `METRICS`; the data set, if any."""

    heading: str
    key: str
    data_set: str


@dataclass(frozen=True)
class PublishedTable:
    """Table of the paper and the protocol of its figures; the head of `figures.yaml` explains each entry."""

    name: str
    place: str
    label: str
    title: str
    region: str
    view: str
    evaluations: Mapping[str, Mapping[str, Any]]
    says: list[str]
    columns: list[PrintedColumn]
    rows: list[list[PrintedCell]]
    legend: Mapping[str, str]
    resolution: str = ""
    subset: str = ""
    oracle_samples: int | None = None
    remarks: list[str] = field(default_factory=list)
    options: Mapping[str, str] = field(default_factory=dict)


def published() -> list[PublishedTable]:
    """Return all tables, in the paper's order."""
    return [_table(entry) for entry in _content()["tables"]]


def _source(table: PublishedTable) -> str:
    marking = "best in bold and second best underlined as printed"
    return f"Published figures: {_content()['source']}, {table.place}; {marking}."


def parse(cell: str) -> PrintedCell:
    """Split a cell: `17.93 best` is the text `17.93` with the mark `best`."""
    words = cell.split()
    return PrintedCell(" ".join(word for word in words if word not in MARKS), frozenset(words) & set(MARKS))


@cache
def _content() -> dict[str, Any]:
    content: Any = OmegaConf.to_container(OmegaConf.load(FILE))
    return dict(content)


def _table(entry: Mapping[str, Any]) -> PublishedTable:
    fields = {key: value for key, value in entry.items() if key not in ("data_set", *MARKS)}
    data_set = {"data_set": entry.get("data_set", "")}
    fields["columns"] = [PrintedColumn(**data_set | column) for column in entry["columns"]]
    fields["rows"] = [[parse(cell) for cell in line.split("|")] for line in entry["rows"].splitlines()]
    return PublishedTable(**fields, legend={mark: entry[mark] for mark in MARKS if mark in entry})


def beside(table: PublishedTable, entries: Sequence[Entry]) -> Table:
    """Return the published rows, followed by those of our runs for which `belongs` is true.

    Times are of one sequence, warm, for the complete pipeline.
    """
    notes = Notes()
    has_speed = any(column.key == "speed" for column in table.columns)
    keys = [key for key in LEADING if key != "speed" or has_speed]
    scored = [column for column in table.columns if column.key in METRICS]
    headings = [*leading_headings(keys), *(Heading(column.heading) for column in scored)]
    rows = [TableRow("paper", _published(table, row, keys)) for row in table.rows]
    for entry in (entry for entry in entries if belongs(table, entry)):
        leading = entry.leading(notes)
        cells = [leading[key] for key in keys]
        for column in scored:
            fits = column.data_set == entry.run.protocol["data_set"]
            cells.append(entry.cell(f"{table.region}_{table.view}_{column.key}", notes) if fits else Cell(ABSENT))
        rows.append(TableRow("ours", cells))
    signs = [f"{SIGNS[mark]}: {meaning}." for mark, meaning in table.legend.items()]
    remarks = [_source(table), *signs, LEGEND, VIEWS, *table.remarks]
    return Table(table.name, f"{table.place}: {table.title}", headings, rows, remarks, notes)


def belongs(table: PublishedTable, entry: Entry) -> bool:
    """Return whether an entry was measured like the table's figures.

    The run followed one of the table's evaluations: the same views, resolution and number of scenes (all scenes of the
    list where the table states no number), on one of the table's data sets and on its list of sequences, with no scene
    skipped, with skip connections at full weight, and on all pixels. A best of k belongs to a table whose best of k has
    the same k. A model that has seen the views that it is scored on belongs to no table.
    """
    protocol = entry.run.protocol
    wanted = table.evaluations.get(str(protocol.get("name")))
    if wanted is None or protocol.get("skipped") or entry.upper_bound:
        return False
    if protocol.get("background") is not None or protocol.get("skip_weight") not in (None, 1):
        return False
    data_sets = {column.data_set for column in table.columns if column.key in METRICS}
    if protocol["data_set"] not in data_sets or (table.subset and protocol.get("subset") != table.subset):
        return False
    if entry.predictor in (BEST_OF_K, BEST_BY_METRIC) and protocol.get("samples") != table.oracle_samples:
        return False
    if protocol["scenes"] not in wanted.get("scenes", [protocol.get("scenes_listed")]):
        return False
    return all(protocol.get(key) == wanted[key] for key in ("resolution", "protocol_views"))


def _size(table: PublishedTable, row: Sequence[PrintedCell]) -> dict[str, str]:
    """Return a row's scenes and resolution as the paper states them; empty where it does not."""
    printed = {column.key: cell.text for column, cell in zip(table.columns, row, strict=True)}
    return {"scenes": printed.get("scenes", ""), "resolution": printed.get("resolution", table.resolution)}


def _published(table: PublishedTable, row: Sequence[PrintedCell], keys: Sequence[str]) -> list[Cell]:
    printed = {column.key: shown(cell) for column, cell in zip(table.columns, row, strict=True)}
    printed |= {key: Cell(text or ABSENT) for key, text in _size(table, row).items()}
    scored = [shown(cell) for column, cell in zip(table.columns, row, strict=True) if column.key in METRICS]
    return [*(printed.get(key, Cell(ABSENT)) for key in keys), *scored]


def shown(printed: PrintedCell) -> Cell:
    """Return the cell of a table for a published cell, its marks as signs and as best or second."""
    signs = "".join(f" {sign}" for mark, sign in SIGNS.items() if mark in printed.marks)
    mark = next((mark for mark in (BEST, SECOND) if mark in printed.marks), UNMARKED)
    return Cell((printed.text or BLANK) + signs, mark)


def published_ablations(table: PublishedTable) -> Table:
    """Return a table of the paper's figures alone."""
    headings = [Heading("setting", figures=False), *(Heading(c.heading, "published") for c in table.columns[1:])]
    body = [TableRow("paper", [shown(cell) for cell in row]) for row in table.rows]
    return Table(table.name, f"{table.place}: {table.title}", headings, body, [_source(table), LEGEND])


def sweep_beside(table: PublishedTable, jobs: Sequence[Job], name: str) -> list[Table]:
    """Return, for each protocol of a sweep's tests, mean and standard deviation over seeds beside the paper's rows.

    The list is empty if no tested job is a row of the paper's table.
    """
    tested = [job for job in jobs if job.protocol]
    if not any(_option(job.label, table) for job in tested):
        return []
    groups = alike((job, job.protocol) for job in tested)
    return [_ablations_beside(table, group, name) for group in groups.values()]


def _ablations_beside(table: PublishedTable, jobs: Sequence[Job], name: str) -> Table:
    protocol, notes = jobs[0].protocol, Notes()
    printed = {row[0].text: [shown(cell) for cell in row] for row in table.rows}
    order = [*printed, ""]
    our_rows = sorted(rows(jobs), key=lambda row: order.index(_option(row["ablation"], table)))
    reasons = protocol.get("missing") or {}
    body = []
    for row, scores in zip(our_rows, figures(our_rows, COLUMNS), strict=True):
        published = printed.get(_option(row["ablation"], table), [Cell(ABSENT)] * len(table.columns))
        counts = [Cell(ABSENT if row[key] is None else str(row[key])) for key in ("seeds", "scenes")]
        cells = [Cell(row["ablation"]), *published, *counts, *_mean_times(jobs, row["ablation"])]
        for column, cell in zip(COLUMNS, scores, strict=True):
            score = column.rpartition("_")[2]
            reason = f"{score}: {reasons.get(score, 'not measured in all jobs of this row')}"
            cells.append(cell if cell.text else notes.missing(reason))
        body.append(TableRow("naive" if row["seeds"] is None else "ours", cells))
    ours = {_option(row["ablation"], table) for row in our_rows}
    absent = [Cell(ABSENT)] * (4 + len(COLUMNS))
    body += [TableRow("paper", [Cell(ABSENT), *row, *absent]) for method, row in printed.items() if method not in ours]
    headings = [Heading("setting", figures=False), Heading("row of the paper", "published", False)]
    headings += [Heading(column.heading, "published") for column in table.columns[1:]]
    group = f"ours: {protocol['data_set']}, {protocol['resolution']} pixels"
    headings += [Heading(text, group) for text in ("seeds", "scenes", *COST, *map(metric, COLUMNS))]
    remarks = [_source(table), f"Ours: {name}, mean ± sample deviation over seeds. {protocol_said(protocol)}"]
    title = f"{table.place}: ablations beside ours on {protocol['data_set']}"
    return Table(f"ablations_{name}", title, headings, body, [*remarks, APART, LEGEND], notes)


def _mean_times(jobs: Sequence[Job], label: str) -> list[Cell]:
    seconds = [job.test.get(MODEL, {}).get("seconds") or {} for job in jobs if job.label == label]
    measured = [[parts[part] for parts in seconds if parts.get(part) is not None] for part in COST]
    return [time_cell(sum(times) / len(times) if times else None) for times in measured]


def _option(label: str, table: PublishedTable) -> str:
    """Return the paper's row that corresponds to a row of ours; empty if there is none."""
    return next((table.options[part] for part in label.split(", ") if part in table.options), "")


def tables(tree: RunTree | None) -> list[Table]:
    """Return the published tables with the runs below a folder, or the published figures alone for None.

    A run is listed below published rows only if it was measured like them, else in a table for its protocol. The jobs
    of a sweep over ablations are listed in the ablation tables alone.

    Raises:
        CompleteSplatError: there are no results.
    """
    if tree is None:
        return [published_ablations(table) if table.options else beside(table, []) for table in published()]
    if not (tree.scores or tree.modes or tree.warnings):
        raise CompleteSplatError(f"runs={tree.folder}: no {SCORES} and no {MODES} in it or below it; {HOW}")
    made: list[Table] = []
    placed = [table for table in published() if not table.options]
    (ablations,) = (table for table in published() if table.options)
    names = {folder: str(folder.relative_to(tree.folder)) for folder in tree.sweeps}
    compared = {folder: sweep_beside(ablations, collect(folder), name) for folder, name in names.items()}
    single = entries([run for run in tree.scores if not compared.get(run.folder.parent)])
    for table in published():
        if table.options:
            made += [ablation for group in compared.values() for ablation in group] or [published_ablations(table)]
        else:
            made.append(beside(table, single))
    elsewhere = [entry for entry in single if not any(belongs(table, entry) for table in placed)]
    return [*made, *own_tables(elsewhere), *mode_tables(tree.modes)]
