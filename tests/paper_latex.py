"""Whether the published figures were typed as the paper's LaTeX prints them."""

import re
from dataclasses import dataclass

from completesplat.results.published import PrintedCell, PublishedTable, published

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
