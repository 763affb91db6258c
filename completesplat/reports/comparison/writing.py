"""The tables as files, and on the terminal."""

import csv
from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path

from completesplat.export.atomic import atomic_path
from completesplat.reports.comparison.cells import Cell, Table
from completesplat.reports.sweeps import latex, markdown
from completesplat.reports.sweeps.latex import escape

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
    lines += [_line([markdown.MARKED[cell.mark].format(_piped(cell)) for cell in row.cells]) for row in table.rows]
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
        lines.append(" & ".join(latex.MARKED[cell.mark] % _tex(cell.text) for cell in row.cells) + r" \\")
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


def _styled(cell: Cell, style: str):
    from rich.text import Text

    return Text(cell.text, style=style)


def _csv_lines(table: Table) -> list[list[str]]:
    lines = []
    for row in table.rows:
        for heading, cell in zip(table.headings, row.cells, strict=True):
            value = "" if cell.value is None else repr(cell.value)
            place = [table.name, table.title, row.source, row.cells[0].text, heading.group, heading.text]
            lines.append([*place, cell.text, cell.mark, value])
    return lines
