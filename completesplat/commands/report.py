"""`completesplat report`: the paper's tables beside our results, and summaries of sweeps."""

import logging
from collections.abc import Sequence
from pathlib import Path

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.paper_tables import published_tables
from completesplat.evaluation.records import find_results
from completesplat.evaluation.sweep_summary import write_summary
from completesplat.evaluation.table_writers import show, write_tables

logger = logging.getLogger(__name__)


def tables(runs: str | None, out: Path) -> None:
    """Write `tables.md`, `.csv` and `.tex` of the results below `runs` (None: the published figures) and print them."""
    tree = None if runs is None else find_results(Path(runs))
    made = published_tables(tree)
    write_tables(made, out)
    show(*made, width=240)
    for warning in tree.warnings if tree else []:
        logger.warning(warning)


def summary(sweeps: Sequence[str], out: Path) -> None:
    """Write and print the summary of a sweep in several folders, or raise CompleteSplatError if a folder is missing."""
    folders = [Path(sweep) for sweep in sweeps]
    for folder in folders:
        if not folder.is_dir():
            raise CompleteSplatError(f"sweeps={folder}: no such folder")
    show(write_summary(out, *folders), width=160)
