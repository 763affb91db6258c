"""Procedural scenes, ray-traced and written to disk in the layouts of the real data sets."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from completesplat.data.toy.objects import write_objects
from completesplat.data.toy.rooms import write_rooms
from completesplat.errors import DataError
from completesplat.settings.schema import Natural, Positive, Side

KINDS: dict[str, Callable[..., Path]] = {
    "objects": write_objects,
    "minis": partial(write_objects, category="toy_minis"),
    "marked_minis": partial(write_objects, category="toy_marked_minis"),
    "rooms": write_rooms,
}


def write(
    kind: str, out: Path, scenes: int, frames: int, size: Side, seed: Natural, workers: Positive | None = None
) -> Path:
    """Write scenes of a kind (a key of `KINDS`) and return their folder.

    Raises:
        DataError: the kind is unknown, or the folder holds something else.
    """
    if kind not in KINDS:
        raise DataError(f"no toy data of kind {kind!r}; there are: {', '.join(KINDS)}")
    return KINDS[kind](out, scenes, frames, size, seed, workers)


__all__ = ["write", "write_objects", "write_rooms"]
