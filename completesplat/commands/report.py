"""`completesplat report`: the paper's tables with our results beside them, and a page with all results."""

import logging
from pathlib import Path
from typing import Annotated, TypedDict

from completesplat.atomic import atomic_path
from completesplat.results.html_page import page
from completesplat.results.published import tables as published_tables
from completesplat.results.runs import find, origin
from completesplat.results.tables import show, write_tables
from completesplat.schema import Positive, Range

logger = logging.getLogger(__name__)


class Most(TypedDict):
    """How much a page holds; `conf/report_task/html.yaml` explains each."""

    frames: Positive
    samples: Positive
    predictions: Positive
    runs: Positive
    pictures: Positive
    megabytes: Annotated[float, Range(1)]


def tables(runs: str | None, out: Path) -> None:
    """Write `tables.md`, `.csv` and `.tex` of the results below `runs` (None: the published figures); print them."""
    tree = None if runs is None else find(Path(runs))
    made = published_tables(tree)
    write_tables(made, out)
    show(*made, width=240)
    for warning in tree.warnings if tree else []:
        logger.warning(warning)


def html(runs: str, most: Most, out: Path) -> None:
    """Write `report.html`, the `page` on all below the folder `runs`, and print its size."""
    text, warnings = page(Path(runs), out, most, origin(out, levels=0))
    with atomic_path(out / "report.html") as temporary:
        temporary.write_text(text, encoding="utf-8")
    for warning in warnings:
        logger.warning(warning)
    print(f"{out / 'report.html'}: {(out / 'report.html').stat().st_size / 1e6:.1f} MB")
