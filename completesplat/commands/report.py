"""`completesplat report`: the paper's tables beside our results, and summaries of sweeps."""

import logging
from collections.abc import Sequence
from pathlib import Path

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.board_tables import board_markdown, board_sections, board_table
from completesplat.evaluation.paper_tables import published_tables
from completesplat.evaluation.records import find_results
from completesplat.evaluation.sweep_summary import write_summary
from completesplat.evaluation.table_writers import show, write_tables
from completesplat.files import write_text

logger = logging.getLogger(__name__)


def tables(runs: str | None, out: Path) -> None:
    """Write `tables.md`, `.csv` and `.tex` of the results below `runs` (None: the published figures) and print them."""
    tree = None if runs is None else find_results(Path(runs))
    made = published_tables(tree)
    write_tables(made, out)
    show(*made, width=240)
    for warning in tree.warnings if tree else []:
        logger.warning(warning)


def board(results: str | None, out: Path) -> None:
    """Write `board.md` and print the tables that have results.

    Args:
        results: folder of further results; None: only those in the package.

    Raises:
        CompleteSplatError: there is no such folder.
    """
    folder = None if results is None else Path(results)
    if folder is not None and not folder.is_dir():
        raise CompleteSplatError(f"results={results}: no such folder")
    sections = board_sections(folder)
    write_text(out / "board.md", board_markdown(sections, out))
    show(*(board_table(section) for section in sections if section.results), width=200)
    for section in sections:
        for reason in section.refused:
            logger.warning(reason)


def summary(sweeps: Sequence[str], out: Path) -> None:
    """Write and print the summary of a sweep in several folders, or raise CompleteSplatError if a folder is missing."""
    folders = [Path(sweep) for sweep in sweeps]
    for folder in folders:
        if not folder.is_dir():
            raise CompleteSplatError(f"sweeps={folder}: no such folder")
    show(write_summary(out, *folders), width=160)
