"""`completesplat report wandb`: what to look at on Weights & Biases."""

from pathlib import Path
from typing import Any


def layout(config: Any, out: Path) -> None:
    """Print the panels that runs with `logger=wandb` have."""
    from completesplat.reports.dashboard.panels import layout
    from completesplat.reports.evaluation_table import show

    show(layout())
