"""Tables on the terminal, made from the rows of a report."""

from collections.abc import Iterable, Sequence
from typing import Any

from rich.table import Table

Column = tuple[str, str, str]  # heading, key of the row, format


def table(title: str, columns: Sequence[Column], rows: Iterable[dict[str, Any]]) -> Table:
    """One line for each row; what a row lacks stays empty."""
    shown = Table(title=title, title_justify="left")
    for heading, _, form in columns:
        shown.add_column(heading, justify="right" if form else "left", no_wrap=True)
    for row in rows:
        values = [(row.get(key), form) for _, key, form in columns]
        shown.add_row(*("" if value is None else format(value, form) for value, form in values))
    return shown
