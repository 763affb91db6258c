"""Tables of results as HTML."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from completesplat.reports.comparison.cells import Cell, Heading, Table
from completesplat.reports.html.markup import Html, element, folded, scrollable
from completesplat.reports.sweeps.headline import BEST, SECOND

MARKED = {BEST: "strong", SECOND: "u"}
PUBLISHED = "paper"
"""The source of rows that are no results of ours."""


def comparison(table: Table) -> Html:
    """A table with what stands below it; without a result of ours it is folded."""
    if is_published(table):
        return folded(f"{table.title}: the published figures, none of ours", _whole(table))
    return _whole(table)


def is_published(table: Table) -> bool:
    """Whether it has the paper's figures only."""
    return all(row.source == PUBLISHED for row in table.rows)


def rows_of(title: str, rows: Sequence[Any]) -> Html:
    """Records with the same keys, such as `completesplat report samplers` writes."""
    records = [row for row in rows if isinstance(row, Mapping)]
    keys = list(dict.fromkeys(str(key) for row in records for key, value in row.items() if _is_plain(value)))
    head = element("tr", *(element("th", key.replace("_", " "), scope="col") for key in keys))
    body = [element("tr", *(element("td", _said(row.get(key))) for key in keys)) for row in records]
    shown = element("table", element("caption", title), element("thead", head), element("tbody", *body))
    return scrollable(title, shown)


def _whole(table: Table) -> Html:
    sources = [row.source for row in [*table.rows[:1], *table.rows]][: len(table.rows)]  # of the row above
    body = [
        element("tr", *map(_cell, table.headings, row.cells), class_="rule" if source != row.source else False)
        for source, row in zip(sources, table.rows, strict=True)
    ]
    shown = element("table", element("caption", table.title), element("thead", *_head(table)), element("tbody", *body))
    below = element("ul", *(element("li", line) for line in table.below()), class_="notes")
    return element(
        "div", scrollable(table.title, shown), folded("What this table says, and how it was measured", below)
    )


def _head(table: Table) -> list[Html]:
    names = [element("th", heading.text, scope="col", class_=_kind(heading)) for heading in table.headings]
    if not any(heading.group for heading in table.headings):
        return [element("tr", *names)]
    groups = [(name, len(list(members))) for name, members in groupby(heading.group for heading in table.headings)]
    above = [element("th", name, scope="colgroup", colspan=count, class_="group") for name, count in groups]
    return [element("tr", *above), element("tr", *names)]


def _cell(heading: Heading, cell: Cell) -> Html:
    text = element(MARKED[cell.mark], cell.text) if cell.mark in MARKED else cell.text
    return element("td", text, class_=_kind(heading))


def _kind(heading: Heading) -> str | bool:
    return False if heading.figures else "words"


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, str | int | float)


def _said(value: Any) -> str:
    return "" if value is None else format(value, ".4g") if isinstance(value, float) else str(value)
