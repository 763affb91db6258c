"""Tables of figures from several sources, and how they are written: Markdown, LaTeX, CSV, on the terminal."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as TerminalTable
from rich.text import Text

from completesplat.atomic import atomic_path

Column = tuple[str, str, str]  # heading, key of the row, format


def table(title: str, columns: Sequence[Column], rows: Iterable[dict[str, Any]]) -> TerminalTable:
    """One line for each row; what a row lacks stays empty."""
    shown = TerminalTable(title=title, title_justify="left")
    for heading, _, form in columns:
        shown.add_column(heading, justify="right" if form else "left", no_wrap=True)
    for row in rows:
        values = [(row.get(key), form) for _, key, form in columns]
        shown.add_row(*("" if value is None else format(value, form) for value, form in values))
    return shown


ALWAYS = ["full_novel_psnr", "full_novel_ssim", "object_novel_psnr", "object_novel_ssim", "full_reference_psnr"]
WHERE_MEASURED = ["full_novel_lpips", "full_novel_fid", "full_novel_kid"]
GROUPS = {
    "full_novel": "all pixels, novel views",
    "object_novel": "object pixels, novel views",
    "full_reference": "reference view",
}
METRICS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "fid": "FID", "kid": "KID", "swd": "SWD"}
FORMATS = {"psnr": ".2f", "ssim": ".3f", "lpips": ".3f", "fid": ".1f", "kid": ".4f", "swd": ".2f"}
LOWER_IS_BETTER = {"lpips", "fid", "kid", "swd"}
SSIM_NOTE = (
    "SSIM: mean over all pixels, the picture mirrored at its border (skimage leaves 5 pixels out on every side)."
)
"""For tables with SSIM: the border is 37 % of the pixels of a picture of 48 x 48, 15 % of one of 128 x 128."""
BEST, SECOND, UNMARKED = "best", "second", ""


def columns(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The metrics to show."""
    return [*ALWAYS, *(name for name in WHERE_MEASURED if any(row.get(f"{name}_mean") is not None for row in rows))]


def group(column: str) -> str:
    """Which pixels of which views."""
    return GROUPS[column.rpartition("_")[0]]


def metric(column: str) -> str:
    """The metric's name with the direction that is better."""
    name = column.rpartition("_")[2]
    return f"{METRICS[name]} {'↓' if name in LOWER_IS_BETTER else '↑'}"


def figure(row: dict[str, Any], column: str) -> str:
    """`21.34 ± 0.12`; without a deviation where there is one seed only, empty where nothing was measured."""
    mean, deviation = row.get(f"{column}_mean"), row.get(f"{column}_deviation")
    form = FORMATS[column.rpartition("_")[2]]
    if mean is None:
        return ""
    return format(mean, form) if deviation is None else f"{mean:{form}} ± {deviation:{form}}"


def marks(rows: Sequence[dict[str, Any]], column: str) -> list[str]:
    """For each row, whether its mean is the best, the second best, or unmarked.

    Means are compared as they are written, so that rows which look equal share a mark. Rows without seeds, the naive
    predictors, and upper bounds do not compete.
    """
    name = column.rpartition("_")[2]
    sign = 1 if name in LOWER_IS_BETTER else -1
    competing = [row["seeds"] is not None and not row["upper_bound"] for row in rows]
    means = [row.get(f"{column}_mean") if competes else None for row, competes in zip(rows, competing, strict=True)]
    written = [None if mean is None else sign * float(format(mean, FORMATS[name])) for mean in means]
    ranked = sorted({value for value in written if value is not None and value == value})  # not-a-number is no rank
    given = dict(zip(ranked, (BEST, SECOND), strict=False))
    return [UNMARKED if value is None else given.get(value, UNMARKED) for value in written]


MARKED_LATEX = {BEST: r"\textbf{%s}", SECOND: r"\underline{%s}", UNMARKED: "%s"}
ESCAPES = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
    | {"±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}
)
MARKED_MARKDOWN = {BEST: "**{}**", SECOND: "<ins>{}</ins>", UNMARKED: "{}"}


def escape(text: str) -> str:
    """Text as LaTeX prints it literally."""
    return text.translate(ESCAPES)


ABSENT = "-"
BLANK = "(blank)"
LEGEND = f"{ABSENT}: not reported, or of another data set than the row's. {BLANK}: left blank in the paper."


@dataclass(frozen=True)
class Cell:
    """What is shown; `BEST`, `SECOND` or `UNMARKED`; and, of our own figures, all digits."""

    text: str
    mark: str = UNMARKED
    value: float | None = None


@dataclass(frozen=True)
class Row:
    """Rows of different sources, such as the paper and a run, are kept apart by a rule."""

    source: str
    cells: list[Cell]


@dataclass(frozen=True)
class Heading:
    """Of a column; the columns of a group share the heading above."""

    text: str
    group: str = ""
    figures: bool = True
    """Whether the column is aligned to the right."""


class Notes:
    """Sentences below a table, each with the number by which cells refer to it."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def number(self, text: str) -> int:
        """The same for the same text."""
        if text not in self.texts:
            self.texts.append(text)
        return self.texts.index(text) + 1

    def missing(self, reason: str) -> Cell:
        """A cell for what was not measured; the reason is a note."""
        return Cell(f"missing: note {self.number(reason.removeprefix('missing: '))}")


@dataclass(frozen=True)
class Table:
    """All that is shown of one table; no cell is empty."""

    name: str
    title: str
    headings: list[Heading]
    rows: list[Row]
    remarks: list[str]
    notes: Notes = field(default_factory=Notes)

    def __post_init__(self) -> None:
        """Refuse a row that does not fit the headings, and an empty cell."""
        for row in self.rows:
            if len(row.cells) != len(self.headings) or not all(cell.text for cell in row.cells):
                raise ValueError(f"{self.name}: {[cell.text for cell in row.cells]} in {len(self.headings)} columns")

    def below(self) -> list[str]:
        """Remarks, and the notes with their numbers."""
        return [*self.remarks, *(f"[{n}] {text}" for n, text in enumerate(self.notes.texts, 1))]


def texts(cells: Sequence[str]) -> list[Cell]:
    """Cells without marks."""
    return [Cell(text) for text in cells]


CSV_COLUMNS = ["table", "title", "source", "row", "group", "column", "text", "mark", "value"]


def write_tables(tables: Sequence[Table], out: Path) -> None:
    """Write `tables.md`, `tables.tex` and `tables.csv`, the last with a line for each cell."""
    texts = {"md": "\n".join(map(as_markdown, tables)), "tex": "\n".join(map(as_latex, tables))}
    for suffix, text in texts.items():
        with atomic_path(out / f"tables.{suffix}") as temporary:
            temporary.write_text(text, encoding="utf-8")
    with atomic_path(out / "tables.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        for table in tables:
            writer.writerows(_csv_lines(table))


def show_tables(tables: Sequence[Table]) -> None:
    """Print all tables with what stands below them."""
    from rich.console import Console
    from rich.table import Table as Shown

    # No markup: a label may hold brackets. Without a terminal, wide enough for all columns.
    console = Console(width=None if Console().is_terminal else 240, markup=False, highlight=False)
    styles = {"best": "bold", "second": "underline"}
    for table in tables:
        shown = Shown(title=table.title, title_justify="left")
        for heading in table.headings:
            text = "\n".join(part for part in (heading.group, heading.text) if part)
            shown.add_column(text, justify="right" if heading.figures else "left", overflow="fold")
        for row, following in zip(table.rows, [*table.rows[1:], None], strict=True):
            ends = following is not None and following.source != row.source
            shown.add_row(*(_styled(cell, styles.get(cell.mark, "")) for cell in row.cells), end_section=ends)
        console.print(shown)
        for line in table.below():
            console.print(line)
        console.print()


def as_markdown(table: Table) -> str:
    """A heading, the table, and a list of remarks and notes."""
    names = [": ".join(part for part in (heading.group, heading.text) if part) for heading in table.headings]
    lines = [_line(names), _line(["---:" if heading.figures else "---" for heading in table.headings])]
    lines += [_line([MARKED_MARKDOWN[cell.mark].format(_piped(cell)) for cell in row.cells]) for row in table.rows]
    below = [f"- {line}" for line in table.below()]
    return "\n".join([f"## {table.title}", "", *lines, "", *below, ""])


def as_latex(table: Table) -> str:
    """A `table*` with booktabs' rules, shrunk to the text's width (`graphicx`), and remarks and notes below."""
    columns = "".join("r" if heading.figures else "l" for heading in table.headings)
    lines = [r"% \usepackage{booktabs,graphicx}", r"\begin{table*}", r"\centering", rf"\caption{{{_tex(table.title)}}}"]
    lines += [r"\resizebox{\textwidth}{!}{%", rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    if any(heading.group for heading in table.headings):
        groups = [(name, len(list(members))) for name, members in groupby(h.group for h in table.headings)]
        lines.append(" & ".join(rf"\multicolumn{{{count}}}{{c}}{{{_tex(name)}}}" for name, count in groups) + r" \\")
    lines += [" & ".join(_tex(heading.text) for heading in table.headings) + r" \\", r"\midrule"]
    for row, following in pairwise([*table.rows, None]):
        assert row is not None
        lines.append(" & ".join(MARKED_LATEX[cell.mark] % _tex(cell.text) for cell in row.cells) + r" \\")
        if following is not None and following.source != row.source:
            lines.append(r"\midrule")
    below = [rf"{_tex(line)}\par" for line in table.below()]
    ends = [r"\bottomrule", r"\end{tabular}}", r"\par\smallskip\footnotesize\raggedright"]
    return "\n".join([*lines, *ends, *below, r"\end{table*}", ""])


def _tex(text: str) -> str:
    return escape(text).replace("†", r"$\dagger$").replace("★", r"$\star$")


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _piped(cell: Cell) -> str:
    return cell.text.replace("|", r"\|")


def _styled(cell: Cell, style: str) -> Text:
    return Text(cell.text, style=style)


def _csv_lines(table: Table) -> list[list[str]]:
    lines = []
    for row in table.rows:
        for heading, cell in zip(table.headings, row.cells, strict=True):
            value = "" if cell.value is None else repr(cell.value)
            place = [table.name, table.title, row.source, row.cells[0].text, heading.group, heading.text]
            lines.append([*place, cell.text, cell.mark, value])
    return lines


COLUMNS = [
    (region, view, metric)
    for region in ("full", "object")
    for view in ("novel", "reference")
    for metric in ("psnr", "ssim")
]
MEASURED_IF_POSSIBLE = ("lpips", "fid", "kid", "swd")
SHORT_FORMATS = {"psnr": ".2f", "fid": ".1f", "kid": ".4f", "swd": ".1f"}
LABELS = {"full": "all\npixels", "object": "object\npixels", "psnr": "PSNR", "ssim": "SSIM"}


def evaluation_table(results: dict[str, Any]) -> TerminalTable:
    """One row for each predictor of `Evaluation.results`, PSNR in dB."""
    first = next(iter(results.values()))
    table = TerminalTable(title=f"{first['scenes']} scenes, {first['views']} novel views", caption=SSIM_NOTE)
    table.add_column("predictor", no_wrap=True)
    more = [("full", "novel", metric) for metric in MEASURED_IF_POSSIBLE if metric in first["full"]["novel"]]
    for region, view, metric in [*COLUMNS, *more]:
        label = LABELS.get(metric, metric.upper())
        table.add_column(f"{LABELS[region]}\n{view}\n{label}", justify="right", no_wrap=True)
    for predictor, scores in results.items():
        cells = [(metric, scores[region][view].get(metric)) for region, view, metric in [*COLUMNS, *more]]
        table.add_row(
            predictor, *("" if x is None else format(x, SHORT_FORMATS.get(metric, ".3f")) for metric, x in cells)
        )
    return table


def show(table: TerminalTable) -> None:
    """Print a table, in full width where the output is no terminal."""
    Console(width=None if Console().is_terminal else 120).print(table)
