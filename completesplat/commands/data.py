"""`completesplat data`: make data sets."""

from pathlib import Path
from typing import Any

from completesplat.errors import DataError


def run(config: Any, out: Path) -> Path:
    """Do the chosen task; returns the place of the data."""
    from completesplat.data.toy import write_objects

    kinds = {"objects": write_objects}
    if config.kind not in kinds:
        raise DataError(f"no toy data of kind {config.kind!r}; there are {', '.join(kinds)}")
    return kinds[config.kind](out, config.scenes, config.frames, config.size, config.seed, config.workers)
