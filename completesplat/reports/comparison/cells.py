"""A table of figures from several sources, before it is written as Markdown, LaTeX or CSV."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from completesplat.reports.sweeps.headline import UNMARKED

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
