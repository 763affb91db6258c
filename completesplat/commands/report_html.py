"""`completesplat report html`: one page with everything, to open without a network and to send on."""

import logging
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError

logger = logging.getLogger(__name__)
LIMITS = ("frames", "samples", "predictions", "runs", "pictures", "megabytes")


def write(config: Any, out: Path) -> None:
    """Write `report.html` and say how large it is.

    Raises:
        CompleteSplatError: a limit below 1, no such folder, or nothing to show in it.
    """
    limits = {name: config.most[name] for name in LIMITS}
    for name, value in limits.items():
        if value < 1:
            raise CompleteSplatError(f"most.{name}={value}: must be at least 1")

    from completesplat.export.atomic import atomic_path
    from completesplat.reports.html.finding import origin
    from completesplat.reports.html.page import Limits, page

    text, warnings = page(Path(config.runs), out, Limits(**limits), origin(out, levels=0))
    with atomic_path(out / "report.html") as temporary:
        temporary.write_text(text, encoding="utf-8")
    for warning in warnings:
        logger.warning(warning)
    print(f"{out / 'report.html'}: {(out / 'report.html').stat().st_size / 1e6:.1f} MB")
