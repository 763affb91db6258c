"""The paper's tables, and our runs beside them where they were measured alike."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from completesplat.results.own import alike, mode_tables, own_tables, protocol_said
from completesplat.results.rows import BEST_OF_K, MODEL, Entry, described, duration, entries, labels, rows
from completesplat.results.runs import Job, collect, find
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
    Row,
    Table,
    figure,
    marks,
    metric,
)

FILE = Path(__file__).with_name("figures.yaml")
MARKS = ("best", "second", "dagger", "star")
METRICS = ("psnr", "lpips", "fid", "kid")


@dataclass(frozen=True)
class Figure:
    """A cell as printed, with its marks, which are among `MARKS`."""

    text: str
    marks: frozenset[str]


@dataclass(frozen=True)
class Column:
    """A column: all levels of its heading joined, and what stands in it."""

    heading: str
    key: str
    """`method`, `speed`, `inference`, `rendering`, `scenes`, `resolution`, or one of `METRICS`."""
    data_set: str
    """As a run's protocol names it; empty where the table holds several and the column belongs to none."""


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper, and the protocol of its figures."""

    name: str
    place: str
    label: str
    title: str
    region: str
    view: str
    evaluations: list[str]
    """The protocols (`conf/evaluation/`) by which a run of ours is measured as these figures are."""
    resolution: str
    """Of all rows; empty where each row states its own."""
    subset: str
    """The list of sequences that the figures are taken to be of; empty where there is one list only."""
    oracle_samples: int | None
    """Of the row "k-best oracle"; None where there is no such row."""
    legend: Mapping[str, str]
    """What the marks dagger and star mean here."""
    says: list[str]
    columns: list[Column]
    rows: list[list[Figure]]
    complete: Mapping[str, str]
    """How many scenes a complete run has, by the number that the paper prints, where they differ."""
    remarks: list[str]
    """What must be known to compare with it."""
    options: Mapping[str, str]
    """Names of our configurations, and the methods that they stand for."""

    def data_sets(self) -> list[str]:
        """Those whose figures the table holds."""
        return list(dict.fromkeys(column.data_set for column in self.columns if column.key in METRICS))


def published() -> list[PublishedTable]:
    """All tables, in the paper's order."""
    return [_table(entry) for entry in _content()["tables"]]


def source() -> str:
    """Authors, title and place of the paper."""
    return _content()["source"]


def parse(cell: str) -> Figure:
    """`17.93 best` is the text `17.93` with the mark `best`."""
    words = cell.split()
    marks = set()
    while words and words[-1] in MARKS:
        marks.add(words.pop())
    return Figure(" ".join(words), frozenset(marks))


@cache
def _content() -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(FILE))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def _table(entry: dict[str, Any]) -> PublishedTable:
    given = {key: entry[key] for key in ("name", "place", "label", "title", "region", "view", "evaluations", "says")}
    columns = [Column(c["heading"], c["key"], c.get("data_set", entry.get("data_set", ""))) for c in entry["columns"]]
    rows = [[parse(cell) for cell in line.split("|")] for line in entry["rows"].splitlines()]
    return PublishedTable(
        **given,
        resolution=entry.get("resolution", ""),
        subset=entry.get("subset", ""),
        oracle_samples=entry.get("oracle_samples"),
        legend={mark: entry[mark] for mark in ("dagger", "star") if mark in entry},
        columns=columns,
        rows=rows,
        complete=entry.get("complete", {}),
        remarks=entry.get("remarks", []),
        options=entry.get("options", {}),
    )


SIGNS = {"dagger": "†", "star": "★"}
IDENTITY = {"method": "method", "speed": "rendering speed"}
COST = {"inference": "inference", "rendering": "rendering"}
LEADING = {**IDENTITY, **COST, "scenes": "scenes", "resolution": "pixels"}
VIEWS = (
    "The paper names both reference and novel views in its protocol and does not say how it weighs them; "
    "our rows are of novel views."
)


def beside(table: PublishedTable, entries: Sequence[Entry]) -> Table:
    """The published rows, then those of our runs that `belongs` lets in.

    Times are of one sequence, warm, for the complete pipeline.
    """
    notes = Notes()
    has_speed = any(column.key == "speed" for column in table.columns)
    keys = [key for key in LEADING if key != "speed" or has_speed]
    figures = [column for column in table.columns if column.key in METRICS]
    headings = [Heading(LEADING[key], _group(key), key not in IDENTITY) for key in keys]
    headings += [Heading(column.heading) for column in figures]
    rows = [Row("paper", _published(table, row, keys)) for row in table.rows]
    for entry in entries:
        if belongs(table, entry):
            cells = [_own(entry, key, notes) for key in keys]
            for column in figures:
                fits = column.data_set == entry.run.protocol["data_set"]
                cells.append(entry.cell(table.region, table.view, column.key, notes) if fits else Cell(ABSENT))
            rows.append(Row("ours", cells))
    marks = [f"{SIGNS[mark]}: {meaning}." for mark, meaning in table.legend.items()]
    remarks = [f"Published figures: {source()}, {table.place}; best in bold and second best underlined as printed."]
    remarks += [*marks, LEGEND, VIEWS, *table.remarks]
    return Table(table.name, f"{table.place}: {table.title}", headings, rows, remarks, notes)


def belongs(table: PublishedTable, entry: Entry) -> bool:
    """Whether an entry was measured as the table's figures were.

    It was tested by one of the table's protocols on one of its data sets and on the table's list of sequences, no scene
    was skipped, and resolution and number of scenes are those of a published row; where the table states no number,
    they are all scenes of the list, and some numbers stand for those of a complete run. A best of k belongs where the
    paper has one of equally many samples; what has seen the views that it is scored on belongs nowhere.
    """
    protocol = entry.run.protocol
    if protocol.get("name") not in table.evaluations:
        return False
    if protocol["data_set"] not in table.data_sets() or protocol.get("skipped") or entry.upper_bound:
        return False
    if table.subset and protocol.get("subset") != table.subset:
        return False
    if entry.predictor == BEST_OF_K and protocol.get("samples") != table.oracle_samples:
        return False
    own = {"scenes": str(protocol["scenes"]), "resolution": str(protocol["resolution"])}
    unstated = {"scenes": str(protocol.get("scenes_listed"))}
    sizes = [_size(table, row) for row in table.rows]
    sizes += [size | {"scenes": table.complete[size["scenes"]]} for size in sizes if size["scenes"] in table.complete]
    return any(
        all(own[key] == (value.replace(",", "") or unstated.get(key, own[key])) for key, value in size.items())
        for size in sizes
    )


def _size(table: PublishedTable, row: Sequence[Figure]) -> dict[str, str]:
    """What the paper states of a row's scenes and resolution; empty where it does not."""
    printed = {column.key: cell.text for column, cell in zip(table.columns, row, strict=True)}
    return {"scenes": printed.get("scenes", ""), "resolution": printed.get("resolution", table.resolution)}


def _published(table: PublishedTable, row: Sequence[Figure], keys: Sequence[str]) -> list[Cell]:
    printed: dict[str, Any] = {column.key: cell for column, cell in zip(table.columns, row, strict=True)}
    sizes = {key: Figure(text or ABSENT, frozenset()) for key, text in _size(table, row).items()}
    nothing = Figure(ABSENT, frozenset())
    first = [shown(sizes.get(key) or printed.get(key, nothing)) for key in keys]
    figures = [cell for column, cell in zip(table.columns, row, strict=True) if column.key in METRICS]
    return [*first, *map(shown, figures)]


def shown(figure: Figure) -> Cell:
    """A published figure, its marks as signs and as best or second."""
    signs = "".join(f" {sign}" for mark, sign in SIGNS.items() if mark in figure.marks)
    mark = next((mark for mark in (BEST, SECOND) if mark in figure.marks), UNMARKED)
    return Cell((figure.text or BLANK) + signs, mark)


def _own(entry: Entry, key: str, notes: Notes) -> Cell:
    if key == "method":
        return Cell(f"{entry.label()} [{notes.number(described(entry.run))}]")
    if key in COST:
        return entry.time(key)
    return Cell(ABSENT if key == "speed" else str(entry.run.protocol[key]))


def _group(key: str) -> str:
    return "time per sequence" if key in COST else ""


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


def tables(folder: Path | None) -> tuple[list[Table], list[str]]:
    """The published tables with the runs below a folder, and warnings about files that were left out.

    A run stands below published rows only if it was measured like them, else in a table of its own protocol. The jobs
    of a sweep over ablations stand in the ablation tables alone. Without a folder: the published figures.

    Raises:
        CompleteSplatError: there is no such folder, or no results in it.
    """
    if folder is None:
        return [beside(table, []) if not table.options else published_ablations(table) for table in published()], []
    found = find(folder)
    (ablations,) = (table for table in published() if table.options)
    sweeps = [sweep for sweep in found.sweeps if is_ablation(sweep, ablations)]
    inside = {str(sweep.relative_to(folder)) for sweep in sweeps}
    single = entries([run for run in found.scores if str(Path(run.name).parent) not in inside])
    made: list[Table] = []
    for table in published():
        if table.options:
            compared = [t for sweep in sweeps for t in sweep_beside(table, sweep, str(sweep.relative_to(folder)))]
            made += compared or [published_ablations(table)]
        else:
            made.append(beside(table, single))
    placed = [entry for entry in single if any(belongs(table, entry) for table in published() if not table.options)]
    elsewhere = [entry for entry in single if not any(entry is other for other in placed)]
    return [*made, *own_tables(elsewhere), *mode_tables(found.modes)], found.warnings
