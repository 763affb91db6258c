"""`completesplat report`: the paper's tables with our results beside them."""

import logging
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)


def tables(config: Any, out: Path) -> None:
    """Write `tables.md`, `tables.csv` and `tables.tex`, and print the tables."""
    from completesplat.reports.comparison.building import tables as made_of
    from completesplat.reports.comparison.writing import show_tables, write_tables

    made, warnings = made_of(None if config.runs is None else Path(config.runs))
    write_tables(made, out)
    show_tables(made)
    for warning in warnings:
        logger.warning(warning)
