"""`completesplat data`: make data sets."""

from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Do the chosen task (`conf/data_task/`)."""
    from hydra.utils import instantiate

    instantiate(config.task, out=out)
