"""`completesplat report`: the paper's tables beside our results, and summaries of sweeps."""

import logging
from collections.abc import Sequence
from pathlib import Path

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.board_results import RESULT, FoundResults, read_results
from completesplat.evaluation.board_tables import board_markdown, board_sections, board_table
from completesplat.evaluation.paper_tables import published_tables
from completesplat.evaluation.records import find_results
from completesplat.evaluation.sweep_summary import write_summary
from completesplat.evaluation.table_writers import show, write_tables
from completesplat.files import write_text
from completesplat.wording import printable

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
    found = FoundResults([], [])
    if results is not None:
        if not Path(results).is_dir():
            raise CompleteSplatError(f"results={results}: no such folder")
        found = read_results(Path(results))
    sections = board_sections(found.results)
    write_text(out / "board.md", board_markdown(sections, out))
    show(*(board_table(section) for section in sections if section.results), width=200)
    left_out = [*found.left_out, *(reason for section in sections for reason in section.refused)]
    names = {section.name for section in sections}
    for result in found.results:
        if result.protocol not in names:
            unknown = f"there is no protocol {printable(result.protocol)} in conf/evaluation here"
            left_out.append(f"{result.file}: left out, because {unknown}")
    for line in left_out:
        logger.warning(line)
    if results is not None and not found.results and not found.left_out:
        logger.warning("results=%s: no %s of completesplat test evaluation=PROTOCOL", results, RESULT)


def summary(sweeps: Sequence[str], out: Path) -> None:
    """Write and print the summary of a sweep in several folders, or raise CompleteSplatError if a folder is missing."""
    folders = [Path(sweep) for sweep in sweeps]
    for folder in folders:
        if not folder.is_dir():
            raise CompleteSplatError(f"sweeps={folder}: no such folder")
    show(write_summary(out, *folders), width=160)
