"""Tables of results: headings by the name of a score, marks of the best, cells, rows and notes, and tables of records.

`table_writers` prints them and writes them to files.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from completesplat.metrics import METRIC_FORMATS, PSNR_LIMIT, MetricFormat

HEADING_GROUPS = {
    "full_novel": "all pixels, novel views",
    "object_novel": "object pixels, novel views",
    "full_reference": "all pixels, reference view",
    "object_reference": "object pixels, reference view",
}
SSIM_NOTE = "SSIM: mean over all pixels, images mirrored at their border (skimage leaves 5 pixels out on every side)."
"""Note below tables with SSIM. The border has 37 % of the pixels of a 48 x 48 image, 15 % of a 128 x 128 one."""
SHARPNESS_NOTE = "Sharpness: gradient energy of the novel views over the truth's; a blur has less than 1."

BEST = "best"
SECOND = "second"
UNMARKED = ""

ABSENT = "-"
BLANK = "(blank)"
LEGEND = f"{ABSENT}: not reported, or of another data set than the row's. {BLANK}: left blank in the paper."

PLAIN = (type(None), str, bool, int, float)
"""Types of values that a table can show."""


def shown_scores(metrics: Collection[str]) -> list[str]:
    """Return the scores (`REGION_VIEW_METRIC`) that a table of these metrics shows if a row has them."""
    names = [f"full_novel_{name}" for name in metrics]
    names += [f"object_novel_{name}" for name in metrics if name not in ("fid", "kid")]
    for region in ("full", "object"):
        names += [f"{region}_reference_psnr", f"{region}_reference_ssim"]
    return names


def metric_of(name: str) -> str:
    """Return the metric of a score named `REGION_VIEW_METRIC`."""
    return name.split("_", 2)[2]


def score_heading(name: str, metric_format: MetricFormat) -> "Heading":
    """Return a heading for a score named `REGION_VIEW_METRIC`: its better direction, grouped by region and view."""
    group = name.removesuffix(f"_{metric_of(name)}")
    return Heading(f"{metric_format.heading} {metric_format.better}".rstrip(), HEADING_GROUPS[group])


def marks(values: Sequence[float | None], competing: Sequence[bool], metric_format: MetricFormat) -> list[str]:
    """Return for each score of a metric the mark of the best, the second best, or none.

    Scores are compared as they are written, so that scores which look equal share a mark; None was not measured. Naive
    predictors and upper bounds are not `competing` and have no mark, nor have metrics without a better direction.
    """
    higher_is_better = metric_format.higher_is_better
    if higher_is_better is None:
        return [UNMARKED] * len(values)
    written: list[float | None] = []
    for value, competes in zip(values, competing, strict=True):
        if value is None or math.isnan(value) or not competes:
            written.append(None)
        else:
            written.append(float(metric_format.text(value)))
    ranked = sorted({value for value in written if value is not None}, reverse=higher_is_better)
    mark_of = dict(zip(ranked, (BEST, SECOND), strict=False))
    return [UNMARKED if value is None else mark_of.get(value, UNMARKED) for value in written]


class Cell(NamedTuple):
    """Text of a cell, its mark (`BEST`, `SECOND` or `UNMARKED`), and the exact value of figures of ours."""

    text: str
    mark: str = UNMARKED
    value: float | None = None


def score_cell(
    metric_format: MetricFormat, value: float | None, deviation: float | None = None, mark: str = UNMARKED
) -> Cell:
    """Return a cell with a score (empty for None), and its deviation if there is one."""
    if value is None:
        return Cell("", mark, value)
    if metric_format == METRIC_FORMATS["psnr"] and value == PSNR_LIMIT:
        return Cell("the same image", mark, value)
    text = metric_format.text(value)
    if deviation is not None:
        text += f" ± {metric_format.text(deviation)}"
    return Cell(text, mark, value)


class TableRow(NamedTuple):
    """Row of a table. A rule separates rows of different sources, such as the paper and a run."""

    source: str
    cells: list[Cell]


class Heading(NamedTuple):
    """Heading of a column, and the format of its values. The columns of a group share the heading above."""

    text: str
    group: str = ""
    figures: bool = True
    """Whether the column is aligned to the right."""
    form: str = ""

    def joined(self, separator: str = ": ") -> str:
        return separator.join(part for part in (self.group, self.text) if part)


class Notes(dict[str, int]):
    """Sentences below a table, each with the number by which cells refer to it."""

    def number(self, text: str) -> int:
        """Return the number of a text, the same for equal texts."""
        return self.setdefault(text, len(self) + 1)


@dataclass(frozen=True)
class Table:
    """Complete content of one table, which `table_writers` prints and writes."""

    name: str
    title: str
    headings: list[Heading]
    rows: list[TableRow]
    remarks: list[str] = field(default_factory=list)
    notes: Notes = field(default_factory=Notes)

    def ruled_rows(self) -> list[tuple[TableRow, bool]]:
        """Return the rows, each with whether a rule separates it from the next one."""
        apart = [row.source != following.source for row, following in pairwise(self.rows)]
        return list(zip(self.rows, [*apart, False], strict=False))

    def below(self) -> list[str]:
        return [*self.remarks, *(f"[{n}] {text}" for text, n in self.notes.items())]


def records_table(
    title: str, records: Sequence[Mapping[str, object]], columns: Mapping[str, Heading] | None = None
) -> Table:
    """Return a table with a row for each record, whose `source` is the row's. Missing values stay empty.

    Without `columns`, the records' keys are the headings, and lists and mappings are left out.
    """
    if columns is None:
        columns = _columns_of(records)
    rows = []
    for record in records:
        cells = [Cell(_written(record.get(key), heading.form)) for key, heading in columns.items()]
        rows.append(TableRow(str(record.get("source", "")), cells))
    return Table(title, title, list(columns.values()), rows)


def _columns_of(records: Sequence[Mapping[str, object]]) -> dict[str, Heading]:
    """Return headings for the records' keys, without those of lists and mappings."""
    columns = {}
    for key in dict.fromkeys(key for record in records for key in record):
        values = [record.get(key) for record in records]
        if all(isinstance(value, PLAIN) for value in values):
            figures = any(isinstance(value, int | float) for value in values)
            columns[key] = Heading(key.replace("_", "\n"), figures=figures)
    return columns


def _written(value: object, form: str) -> str:
    """Return a value as text. Without a format, a float below 1000 has four digits, a larger one no decimals."""
    if value is None:
        return ""
    if form:
        return format(value, form)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1000 else f"{value:,.0f}"
