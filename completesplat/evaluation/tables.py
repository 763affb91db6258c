"""Table type of all results, and its writers for Markdown, LaTeX, CSV and the terminal."""

import csv
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from completesplat.files import atomic_path, write_text
from completesplat.metrics import METRIC_FORMATS, PSNR_LIMIT, MetricFormat

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table as PrintedTable

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
MARKED_MARKDOWN = {BEST: "**{}**", SECOND: "<ins>{}</ins>", UNMARKED: "{}"}
MARKED_LATEX = {BEST: r"\textbf{%s}", SECOND: r"\underline{%s}", UNMARKED: "%s"}
MARKED_TERMINAL = {BEST: "bold", SECOND: "underline", UNMARKED: ""}
LATEX: dict[str, str | int | None] = {
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "†": r"$\dagger$",
    "★": r"$\star$",
}
"""LaTeX of characters that it does not print literally."""
LINE = re.compile(r".+")
WORD = re.compile(r"\S+(?: [↑↓])?")
"""Words, which do not break: a column is at least as wide as its longest."""
ABSENT = "-"
BLANK = "(blank)"
LEGEND = f"{ABSENT}: not reported, or of another data set than the row's. {BLANK}: left blank in the paper."

PLAIN = (type(None), str, bool, int, float)
"""Types of values that a table can show."""
CSV_COLUMNS = ["table", "title", "source", "row", "group", "column", "text", "mark", "value"]


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
    """Complete content of one table, which rich can print."""

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

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> Iterator["PrintedTable"]:
        """Yield the table, in parts that repeat the first column if the words of all columns do not fit side by side.

        No column is narrower than its longest word, up to half the width; space that is left goes to the first columns.
        """
        from rich.table import Table as PrintedTable
        from rich.text import Text

        columns = []
        for i, heading in enumerate(self.headings):
            columns.append([heading.joined("\n"), *(row.cells[i].text for row in self.rows)])
        room = options.max_width - 1
        most = options.max_width // 2 - 4  # without borders; two columns always fit
        lines = [_longest(LINE, column) for column in columns]
        words = [min(most, _longest(WORD, column)) for column in columns]
        parts = _side_by_side(words, room)
        for part in parts:
            spare = room - sum(words[i] + 3 for i in part)
            printed = PrintedTable(title=self.title if part is parts[0] else None, title_justify="left")
            for i in part:
                width = min(lines[i], words[i] + spare)
                spare -= width - words[i]
                side: Literal["left", "right"] = "right" if self.headings[i].figures else "left"
                printed.add_column(columns[i][0], justify=side, overflow="fold", width=width)
            for row, ruled in self.ruled_rows():
                cells = [row.cells[i] for i in part]
                printed.add_row(*(Text(x.text, MARKED_TERMINAL[x.mark]) for x in cells), end_section=ruled)
            yield printed


def _longest(pattern: re.Pattern[str], texts: Sequence[str]) -> int:
    return max((len(word) for text in texts for word in pattern.findall(text)), default=0)


def _side_by_side(widths: Sequence[int], room: int) -> list[list[int]]:
    """Return the columns of each part of a table. All parts begin with column 0 and fit into the room if two do."""
    parts = [[0]]
    for index in range(1, len(widths)):
        if len(parts[-1]) > 1 and sum(widths[i] + 3 for i in (*parts[-1], index)) > room:
            parts.append([0])
        parts[-1].append(index)
    return parts


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


def show(*tables: Table, width: int = 120) -> None:
    """Print tables, their remarks and notes, `width` characters wide if the output is not a terminal."""
    from rich.console import Console

    console = Console(width=None if Console().is_terminal else width, markup=False, highlight=False)
    for index, table in enumerate(tables):
        if index:
            console.print()
        console.print(table)
        for line in table.below():
            console.print(line)


def escape(text: str) -> str:
    """Escape text so that LaTeX prints it literally."""
    return text.translate(str.maketrans(LATEX))


def as_markdown(table: Table) -> str:
    """Return a heading, the table, and a list of remarks and notes."""
    lines = [[heading.joined().replace("|", r"\|") for heading in table.headings]]
    lines.append(["---:" if heading.figures else "---" for heading in table.headings])
    for row in table.rows:
        lines.append([MARKED_MARKDOWN[cell.mark].format(cell.text.replace("|", r"\|")) for cell in row.cells])
    body = [f"| {' | '.join(line)} |" for line in lines]
    below = [f"- {line}" for line in table.below()]
    return "\n".join([f"## {table.title}", "", *body, "", *below, ""])


def as_latex(table: Table) -> str:
    """Return a `table*` with booktabs' rules, shrunk to the text's width, with remarks and notes below."""
    columns = "".join("r" if heading.figures else "l" for heading in table.headings)
    lines = [
        r"% \usepackage{booktabs,graphicx}",
        r"\begin{table*}",
        r"\centering",
        rf"\caption{{{escape(table.title)}}}",
        r"\resizebox{\textwidth}{!}{%",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
    ]
    if any(heading.group for heading in table.headings):
        spans = []
        for name, members in groupby(heading.group for heading in table.headings):
            spans.append(rf"\multicolumn{{{len(list(members))}}}{{c}}{{{escape(name)}}}")
        lines.append(rf"{' & '.join(spans)} \\")
    lines += [rf"{' & '.join(escape(heading.text) for heading in table.headings)} \\", r"\midrule"]
    for row, ruled in table.ruled_rows():
        lines.append(" & ".join(MARKED_LATEX[cell.mark] % escape(cell.text) for cell in row.cells) + r" \\")
        if ruled:
            lines.append(r"\midrule")
    lines += [r"\bottomrule", r"\end{tabular}}", r"\par\smallskip\footnotesize\raggedright"]
    lines += [rf"{escape(line)}\par" for line in table.below()]
    return "\n".join([*lines, r"\end{table*}", ""])


def write_documents(tables: Sequence[Table], stem: Path) -> None:
    """Write `STEM.md` and `STEM.tex`."""
    write_text(stem.with_suffix(".md"), "\n".join(map(as_markdown, tables)))
    write_text(stem.with_suffix(".tex"), "\n".join(map(as_latex, tables)))


def write_tables(tables: Sequence[Table], out: Path) -> None:
    """Write `tables.md`, `tables.tex`, and `tables.csv` with a line for each cell."""
    out.mkdir(parents=True, exist_ok=True)
    write_documents(tables, out / "tables")
    lines = []
    for table in tables:
        for row in table.rows:
            first = row.cells[0].text
            for heading, cell in zip(table.headings, row.cells, strict=True):
                place = [table.name, table.title, row.source, first, heading.group, heading.text]
                lines.append([*place, cell.text, cell.mark, cell.value])
    write_csv(out / "tables.csv", CSV_COLUMNS, lines)


def write_csv(path: Path, header: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    """Write a CSV file. None is an empty field, and numbers have all digits."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(lines)
