"""Writer of toy data: folders are written atomically, and scenes are rendered in parallel."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import track

from completesplat.data.processes import map_in_processes
from completesplat.errors import DataError
from completesplat.files import atomic_folder
from completesplat.settings.schema import Range

FORMAT_VERSION = 2
MOST_FRAMES = 1000

Result = TypeVar("Result")


def write_once(folder: Path, fill: Callable[[Path], None], progress: bool, fewest: int, **numbers: int) -> Path:
    """Make `folder`, let `fill` write into it, and finally write the numbers to `toy.json`.

    The bytes depend only on `scenes` (at least `fewest`), `frames`, `size` and `seed`. A folder that was made with the
    same numbers remains unchanged.

    Raises:
        DataError: a number is out of its range, or the folder holds something else.
        DiskError: the disk is full.
    """
    for name, rule in {"scenes": Range(fewest), "frames": Range(2, MOST_FRAMES), "size": Range(8)}.items():
        if (reason := rule.refusal(numbers[name])) is not None:
            raise DataError(f"{folder.name}: {name}={numbers[name]}: {reason}")
    parameters = {"format": FORMAT_VERSION, **numbers}
    if folder.exists():
        try:
            existing = json.loads((folder / "toy.json").read_text())
        except (OSError, ValueError):
            existing = None
        if existing != parameters:
            raise DataError(f"{folder} already holds something else: remove it or choose another folder")
        if progress:
            Console().print(f"{folder} already holds these scenes")
        return folder
    with atomic_folder(folder) as unfinished:
        fill(unfinished)
        (unfinished / "toy.json").write_text(json.dumps(parameters, indent=1) + "\n")
    return folder


def write_scenes(
    write: Callable[[tuple[int, str]], Result], splits: Sequence[str], workers: int | None, name: str, progress: bool
) -> list[Result]:
    """Call `write` with (index, split) of every scene in `workers` processes (None: one for each core), in order."""
    written = map_in_processes(write, list(enumerate(splits)), workers)
    return list(track(written, f"Rendering {name}", len(splits), disable=not progress))
