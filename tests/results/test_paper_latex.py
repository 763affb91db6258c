"""The typed figures against LaTeX: of the paper where it is at hand, of a small table of the same form always."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from completesplat.results.published import PrintedCell, PrintedColumn, PublishedTable, parse, published

ENVIRONMENT = re.compile(r"\\begin\{table(\*?)\}.*?\\end\{table\1\}", re.DOTALL)
COMMENT = re.compile(r"(?<!\\)%.*")
DECORATION = re.compile(
    r"\\(?:top|mid|bottom)rule|\\hline|\\cmidrule(?:\([lr]*\))?\{[^}]*\}|\\(?:row|cell)color(?:\[\w*\])?\{[^}]*\}"
)
SPAN = re.compile(r"\\multi(row|column)\{(-?\d+)\}\{[^}]*\}\{(.*)\}", re.DOTALL)
MARKED = {
    "best": re.compile(r"\\textbf|\\bf\b"),
    "second": re.compile(r"\\underline|\\ul\b"),
    "dagger": re.compile(r"\$\\dagger\$"),
    "star": re.compile(r"\$\\star\$"),
}
CITATION = re.compile(r"~?\\cite\{[^}]*\}")


@dataclass(frozen=True)
class Grid:
    """Headings, all levels of one joined, and the cells below them."""

    headings: list[str]
    rows: list[list[PrintedCell]]


def environment(text: str, label: str) -> str | None:
    """The `table` with a label; None if there is none."""
    tables = (match.group() for match in ENVIRONMENT.finditer(text))
    return next((table for table in tables if rf"\label{{{label}}}" in table), None)


def grid(table: str, last_heading: str) -> Grid:
    """The tabular of a table whose headings end with the first row that holds the text `last_heading`.

    Cells that span rows or columns are repeated.

    Raises:
        ValueError: there is no such row.
    """
    lines = [line for line in map(_cells, re.split(r"\\\\", _body(table))) if any(cell.strip() for cell in line)]
    rows = _spread([[_span(cell) for cell in line] for line in lines])
    for index, row in enumerate(rows):
        if any(last_heading in cell.text for cell in row):
            levels = zip(*rows[: index + 1], strict=False)
            headings = [" ".join(dict.fromkeys(cell.text for cell in column if cell.text)) for column in levels]
            return Grid(headings, rows[index + 1 :])
    raise ValueError(f"no heading with {last_heading}")


def figure(cell: str) -> PrintedCell:
    """Text and marks of a cell: bold is the best, underlined the second."""
    marks = frozenset(mark for mark, pattern in MARKED.items() if pattern.search(cell))
    for pattern in (CITATION, *MARKED.values()):
        cell = pattern.sub("", cell)
    return PrintedCell(" ".join(re.sub(r"[{}]", "", cell).replace(r"\#", "#").split()), marks)


def _body(table: str) -> str:
    """What stands between the `{` behind the columns' format and the end of the tabular."""
    body = COMMENT.sub("", table).partition(r"\begin{tabular}")[2].partition(r"\end{tabular}")[0]
    depth = 0
    for index, character in enumerate(body):
        depth += (character == "{") - (character == "}")
        if depth == 0 and index:
            return body[index + 1 :]
    raise ValueError("no tabular")


def _cells(line: str) -> list[str]:
    return re.split(r"(?<!\\)&", DECORATION.sub("", line))


def _span(cell: str) -> tuple[PrintedCell, int, int]:
    """The cell, and how many rows (upwards if negative) and columns it spans."""
    match = SPAN.fullmatch(cell.strip())
    if match is None:
        return figure(cell), 1, 1
    direction, count, content = match.groups()
    return figure(content), int(count) if direction == "row" else 1, int(count) if direction == "column" else 1


def _spread(lines: list[list[tuple[PrintedCell, int, int]]]) -> list[list[PrintedCell]]:
    rows = [[cell for cell, _, columns in line for _ in range(columns)] for line in lines]
    for index, line in enumerate(lines):
        place = 0
        for cell, count, columns in line:
            span = range(index, index + count) if count > 0 else range(index + count + 1, index + 1)
            for other in span if count != 1 else ():
                if 0 <= other < len(rows) and place < len(rows[other]):
                    rows[other][place] = cell
            place += columns
    return rows


def check(paper_text: str) -> list[str]:
    """All differences between the data file and the LaTeX of the paper; empty where there are none."""
    return [difference for table in published() for difference in differences(table, paper_text)]


def differences(table: PublishedTable, paper_text: str) -> list[str]:
    """Those of one table: headings, cells with their marks, and the phrases that it says."""
    found = environment(paper_text, table.label)
    if found is None:
        return [f"{table.name}: the paper has no table labelled {table.label}"]
    said = " ".join(found.split())
    wrong = [f"{table.name}: the paper does not say {phrase!r}" for phrase in table.says if phrase not in said]
    try:
        printed = grid(found, "PSNR")
    except ValueError as error:
        return [*wrong, f"{table.name}: {error}"]
    headings = [column.heading for column in table.columns]
    if headings != printed.headings:
        wrong.append(f"{table.name}: the headings are {headings}, the paper's {printed.headings}")
    if len(table.rows) != len(printed.rows):
        wrong.append(f"{table.name}: {len(table.rows)} rows, the paper has {len(printed.rows)}")
    for typed, row in zip(table.rows, printed.rows, strict=False):
        wrong += [f"{table.name}: {difference}" for difference in _row(typed, row, headings)]
    return wrong


def _row(typed: list[PrintedCell], printed: list[PrintedCell], headings: list[str]) -> list[str]:
    name = " / ".join(cell.text for cell in typed[:2])
    if len(typed) != len(printed):
        return [f"{name}: {len(typed)} cells, the paper has {len(printed)}"]
    return [
        f"{name}, {heading}: {_said(one)}, the paper prints {_said(other)}"
        for one, other, heading in zip(typed, printed, headings, strict=False)
        if one != other
    ]


def _said(cell: PrintedCell) -> str:
    return " ".join([repr(cell.text), *sorted(cell.marks)])


PAPER = os.environ.get("COMPLETESPLAT_PAPER")
SMALL = r"""
\begin{table} \label{other} \begin{tabular}{l} \toprule x \\ \end{tabular} \end{table}
\begin{table*}
    \resizebox{1.0\linewidth}{!}{
    \begin{tabular}{@{}clcc@{}}
        \toprule % a remark with & and \\
        \textbf{Rendering} & \multirow{2}{*}{\textbf{Methods}} & \multicolumn{2}{c}{\textbf{Apples}} \\
        \cmidrule(l){3-4}
        \textbf{Speed} & & \textbf{PSNR ↑} & \textbf{\# LPIPS ↓} \\ \midrule
        \multirow{2}{*}{Slow} & One~\cite{one} $\dagger$ & \textbf{17.90} & 0.54 \\
         & Two \cite{two} & - & \\
        \cmidrule(l){2-4}
        \cmidrule(l){2-4}
        \rowcolor[HTML]{EFEFEF} & Three $\star$ & {\ul 17.4} & {\bf 0.4} \\
        \rowcolor[HTML]{EFEFEF} \multirow{-2}{*}{Fast} & \cellcolor[HTML]{EFEFEF}Four & \underline{17.4}
          & { 0.40} \\ \hline
    \end{tabular} }
    \caption{$\dagger$: cited   from
      \cite{one}.}
    \label{small}
\end{table*}
"""
ROWS = """Slow | One dagger | 17.90 best | 0.54
Slow | Two | - |
Fast | Three star | 17.4 second | 0.4 best
Fast | Four | 17.4 second | 0.40"""
HEADINGS = {"Rendering Speed": "speed", "Methods": "method", "Apples PSNR ↑": "psnr", "Apples # LPIPS ↓": "lpips"}


def table(rows: str = ROWS, label: str = "small", says: str = r"$\dagger$: cited from \cite{one}") -> PublishedTable:
    columns = [PrintedColumn(heading, key, "") for heading, key in HEADINGS.items()]
    cells = [[parse(cell) for cell in line.split("|")] for line in rows.splitlines()]
    return PublishedTable("small", "Table 1", label, "", "full", "novel", [], [says], columns, cells, {})


@pytest.mark.skipif(PAPER is None, reason="COMPLETESPLAT_PAPER does not name the LaTeX of the paper")
def test_the_published_figures_are_typed_as_the_paper_prints_them() -> None:
    assert check(Path(PAPER or "").read_text(encoding="utf-8")) == []


def test_a_table_typed_as_printed_has_no_differences() -> None:
    assert differences(table(), SMALL) == []


@pytest.mark.parametrize(
    ("typed", "wrong", "said"),
    [
        ("17.90 best", "17.9 best", "Slow / One, Apples PSNR ↑: '17.9' best, the paper prints '17.90' best"),
        ("One dagger", "One", "Methods: 'One', the paper prints 'One' dagger"),
        ("Two | - |", "Two | - | -", "Apples # LPIPS ↓: '-', the paper prints ''"),
        ("Fast | Three", "Slow | Three", "Rendering Speed: 'Slow', the paper prints 'Fast'"),
        ("Fast | Four | 17.4 second | 0.40", "Fast | Four | 17.4 second", "3 cells, the paper has 4"),
        ("\nFast | Four | 17.4 second | 0.40", "", "3 rows, the paper has 4"),
    ],
)
def test_every_difference_is_found(typed, wrong, said) -> None:
    assert typed in ROWS
    (found,) = differences(table(ROWS.replace(typed, wrong)), SMALL)
    assert said in found


def test_another_heading_phrase_or_table_and_a_table_without_headings_are_differences() -> None:
    (found,) = differences(table(), SMALL.replace("Apples", "Pears"))
    assert "Pears PSNR" in found
    assert differences(table(says="in inches"), SMALL) == ["small: the paper does not say 'in inches'"]
    assert differences(table(label="nowhere"), SMALL) == ["small: the paper has no table labelled nowhere"]
    assert differences(table(label="other", says="x"), SMALL) == ["small: no heading with PSNR"]


def test_a_paper_without_tables_differs_in_all() -> None:
    assert len(check("")) == len(published())


@pytest.mark.parametrize(
    ("latex", "typed"),
    [
        (r"{\ul 0.25}", "0.25 second"),
        (r"{\bf 0.477} ", "0.477 best"),
        (r"\underline{0.111}", "0.111 second"),
        (r" A~\cite{a, b} $\dagger$", "A dagger"),
        (r"\# 6,473", "# 6,473"),
    ],
)
def test_a_cell_is_read_as_it_is_typed(latex, typed) -> None:
    assert figure(latex) == parse(typed)


def test_every_table_is_complete() -> None:
    for known in published():
        assert all(len(row) == len(known.columns) for row in known.rows)
        assert all(column.data_set for column in known.columns if column.key in ("psnr", "lpips", "fid", "kid"))
        signs = {mark for row in known.rows for cell in row for mark in cell.marks} & {"dagger", "star"}
        assert signs == set(known.legend)
    places = [known.place for known in published()]
    assert len(set(places)) == len(places) == 4


def test_the_protocols_of_the_tables_are_there() -> None:
    from completesplat.commands import conf_folder

    there = {path.stem for path in (conf_folder() / "evaluation").glob("*.yaml")}
    assert {name for known in published() for name in known.evaluations} <= there


def test_every_ablation_that_a_sweep_can_name_is_a_row() -> None:
    from completesplat.commands import conf_folder

    (ablations,) = (known for known in published() if known.options)
    assert set(ablations.options.values()) == {row[0].text for row in ablations.rows}
    named = {path.stem for folder in ("ablation", "model") for path in (conf_folder() / folder).glob("*.yaml")}
    assert set(ablations.options) <= named
    assert {path.stem for path in (conf_folder() / "ablation").glob("*.yaml")} <= set(ablations.options)
