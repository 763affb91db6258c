"""A published table with our runs below, where they were measured by the table's protocol."""

from collections.abc import Sequence
from typing import Any

from completesplat.reports.comparison.cells import ABSENT, BLANK, LEGEND, Cell, Heading, Notes, Row, Table
from completesplat.reports.comparison.entries import BEST_OF_K, Entry, described
from completesplat.reports.published.figures import METRICS, Figure, PublishedTable, source
from completesplat.reports.sweeps.headline import BEST, SECOND, UNMARKED

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
