"""`completesplat test`: score a trained model as the chosen protocol says (`conf/evaluation/`)."""

from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Measure what the protocol measures."""
    from hydra.utils import get_method

    get_method(config.evaluation.task)(config, out)
