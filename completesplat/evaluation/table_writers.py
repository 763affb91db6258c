"""Writers of tables for the terminal, Markdown, LaTeX and CSV, and the folder with a table in all of these files."""

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from completesplat.evaluation.tables import BEST, SECOND, UNMARKED, Table
from completesplat.files import atomic_path, write_text

if TYPE_CHECKING:
    from rich.table import Table as PrintedTable

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
MARKUP = re.compile(r"[\\|<`*]|(?<!\w)_|_(?!\w)|(?<=\])\(")
"""What Markdown may read as markup. Underscores within words are none."""
LINE = re.compile(r".+")
WORD = re.compile(r"\S+(?: [↑↓])?")
"""Words, which do not break: a column is at least as wide as its longest."""
CSV_COLUMNS = ["table", "title", "source", "row", "group", "column", "text", "mark", "value"]


def show(*tables: Table, width: int = 120) -> None:
    """Print tables, their remarks and notes, `width` characters wide if the output is not a terminal."""
    from rich.console import Console

    console = Console(width=None if Console().is_terminal else width, markup=False, highlight=False)
    for index, table in enumerate(tables):
        if index:
            console.print()
        console.print(*_printed_parts(table, console.width))
        for line in table.below():
            console.print(line)


def _printed_parts(table: Table, width: int) -> Iterator["PrintedTable"]:
    """Yield a table for a console, in parts that repeat the first column if the words of all columns do not fit.

    No column is narrower than its longest word, up to half of `width`. Space that is left goes to the first columns.
    """
    from rich.table import Table as PrintedTable
    from rich.text import Text

    columns = []
    for i, heading in enumerate(table.headings):
        columns.append([heading.joined("\n"), *(row.cells[i].text for row in table.rows)])
    room = width - 1
    most = width // 2 - 4  # without borders; two columns always fit
    lines = [_longest(LINE, column) for column in columns]
    words = [min(most, _longest(WORD, column)) for column in columns]
    parts = _side_by_side(words, room)
    for part in parts:
        spare = room - sum(words[i] + 3 for i in part)
        printed = PrintedTable(title=table.title if part is parts[0] else None, title_justify="left")
        for i in part:
            own_width = min(lines[i], words[i] + spare)
            spare -= own_width - words[i]
            side: Literal["left", "right"] = "right" if table.headings[i].figures else "left"
            printed.add_column(columns[i][0], justify=side, overflow="fold", width=own_width)
        for row, ruled in table.ruled_rows():
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


def escape(text: str) -> str:
    """Escape text so that LaTeX prints it literally."""
    return text.translate(str.maketrans(LATEX))


def markdown(text: str) -> str:
    """Escape text, such as the name of a folder, so that Markdown prints it literally."""
    return MARKUP.sub(r"\\\g<0>", text)


def as_markdown(table: Table) -> str:
    """Return a heading, the table, and a list of remarks and notes."""
    lines = [[markdown(heading.joined()) for heading in table.headings]]
    lines.append(["---:" if heading.figures else "---" for heading in table.headings])
    for row in table.rows:
        lines.append([MARKED_MARKDOWN[cell.mark].format(markdown(cell.text)) for cell in row.cells])
    body = [f"| {' | '.join(line)} |" for line in lines]
    below = [f"- {markdown(line)}" for line in table.below()]
    return "\n".join([f"## {markdown(table.title)}", "", *body, "", *below, ""])


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
