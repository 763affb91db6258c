"""`completesplat bench`: what takes how long, side by side in one process."""

from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Do the chosen task (`conf/bench_task/`)."""
    from hydra.utils import get_method

    get_method(config.task)(config, out)
