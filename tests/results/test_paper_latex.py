"""The typed figures against the paper's LaTeX, where it is at hand."""

import os
import re
from itertools import zip_longest
from pathlib import Path

import pytest

from completesplat.commands import conf_folder
from completesplat.evaluation import paper_tables
from completesplat.evaluation.tables import BLANK, Cell

ENVIRONMENT = re.compile(r"\\begin\{table(\*?)\}.*?\\end\{table\1\}", re.DOTALL)
COMMENT = re.compile(r"(?<!\\)%.*")
RULES, COLORS = r"\\(?:top|mid|bottom)rule|\\hline", r"\\(?:row|cell)color(?:\[\w*\])?\{[^}]*\}"
DECORATION = re.compile(rf"{RULES}|\\cmidrule(?:\([lr]*\))?\{{[^}}]*\}}|{COLORS}")
SPAN = re.compile(r"\\multi(row|column)\{(-?\d+)\}\{[^}]*\}\{(.*)\}", re.DOTALL)
MARKED = {"best": r"\\textbf|\\bf\b", "second": r"\\underline|\\ul\b", "dagger": r"\$\\dagger\$", "star": r"\$\\star\$"}


def grid(table: str, last_heading: str) -> tuple[list[str], list[list[Cell]]] | None:
    """Return joined headings, and the cells below them, repeated where they span rows or columns.

    The headings end with the first row that holds the text `last_heading`.
    """
    lines = [line for line in map(_cells, re.split(r"\\\\", _body(table))) if any(cell.strip() for cell in line)]
    rows = _spread([[_span(cell) for cell in line] for line in lines])
    for index, row in enumerate(rows):
        if any(last_heading in cell.text for cell in row):
            columns = zip(*rows[: index + 1], strict=False)
            texts = ([cell.text for cell in column if cell.text != BLANK] for column in columns)
            headings = [" ".join(dict.fromkeys(levels)) for levels in texts]
            return headings, rows[index + 1 :]
    return None


def figure(cell: str) -> Cell:
    """Text and marks of a cell: bold is the best, underlined the second."""
    marks = [mark for mark, pattern in MARKED.items() if re.search(pattern, cell)]
    for pattern in (r"~?\\cite\{[^}]*\}", *MARKED.values()):
        cell = re.sub(pattern, "", cell)
    return paper_tables.parse_cell(" ".join([re.sub(r"[{}]", "", cell).replace(r"\#", "#"), *marks]))


def _body(table: str) -> str:
    """Return the text between the columns' format and the end of the tabular."""
    body = COMMENT.sub("", table).partition(r"\begin{tabular}")[2].partition(r"\end{tabular}")[0]
    depth = 0
    for index, character in enumerate(body):
        depth += (character == "{") - (character == "}")
        if depth == 0 and index:
            return body[index + 1 :]
    raise ValueError("no tabular")


def _cells(line: str) -> list[str]:
    return re.split(r"(?<!\\)&", DECORATION.sub("", line))


def _span(cell: str) -> tuple[Cell, int, int]:
    """Return the cell, and the numbers of rows (upwards if negative) and columns that it spans."""
    match = SPAN.fullmatch(cell.strip())
    if match is None:
        return figure(cell), 1, 1
    direction, count, content = match.groups()
    return figure(content), int(count) if direction == "row" else 1, int(count) if direction == "column" else 1


def _spread(lines: list[list[tuple[Cell, int, int]]]) -> list[list[Cell]]:
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


def differences(table: paper_tables.PublishedTable, paper_text: str) -> list[str]:
    """Return the differences of a table from LaTeX: headings, cells with their marks, and phrases."""
    latex = next((m.group() for m in ENVIRONMENT.finditer(paper_text) if rf"\label{{{table.label}}}" in m.group()), "")
    text = " ".join(latex.split())
    wrong = [f"{table.name}: the paper does not say {phrase!r}" for phrase in table.says if phrase not in text]
    printed = grid(latex, "PSNR") if latex else None
    if printed is None:
        return [*wrong, f"{table.name}: the paper has no table of PSNR labelled {table.label}"]
    typed = [[column.heading for column in table.columns], *paper_tables.printed_rows(table)]
    for row, other in zip_longest(typed, [printed[0], *printed[1]], fillvalue=()):
        pairs = (pair for pair in zip_longest(row, other) if pair[0] != pair[1])
        wrong += [f"{table.name}: {ours}, the paper prints {theirs}" for ours, theirs in pairs]
    return wrong


PAPER = os.environ.get("COMPLETESPLAT_PAPER")


@pytest.mark.skipif(PAPER is None, reason="COMPLETESPLAT_PAPER does not name the LaTeX of the paper")
def test_the_published_figures_are_typed_as_the_paper_prints_them() -> None:
    paper = Path(PAPER or "").read_text(encoding="utf-8")
    assert [difference for known in paper_tables.read_tables() for difference in differences(known, paper)] == []


def test_every_table_is_complete() -> None:
    for known in paper_tables.read_tables():
        assert all(len(row) == len(known.columns) for row in paper_tables.printed_rows(known))
        assert all(data_set for *_, data_set in paper_tables.score_columns(known))
        text = " ".join(cell.text for row in paper_tables.printed_rows(known) for cell in row)
        signs = {name for name, sign in paper_tables.SIGNS.items() if sign in text}
        assert signs == set(known.get("legend", {}))
    assert len({known.place for known in paper_tables.read_tables()}) == len(paper_tables.read_tables()) == 4


def names(*folders: str) -> set[str]:
    return {path.stem for folder in folders for path in (conf_folder() / folder).glob("*.yaml")}


def test_every_protocol_of_a_table_is_there_and_every_option_of_a_row() -> None:
    assert {name for known in paper_tables.read_tables() for name in known.evaluations} <= names("evaluation")
    (ablations,) = (known for known in paper_tables.read_tables() if known.get("options"))
    assert set(ablations.options.values()) == {row[0].text for row in paper_tables.printed_rows(ablations)}
    assert set(ablations.options) <= names("ablation", "model")
