"""Folders with something to show: runs of `completesplat`, and predictions."""

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError

SCENE, RECORD, CONFIG = "scene.json", "run.json", "config.yaml"
ROWS = ("samplers.json", "controls.json", "depth.json")
"""What `completesplat report NAME` leaves beside its figure: settings and rows."""
FIGURES = {"": "*.png", "pictures": "step_*.png", "samples": "*.png"}
"""Subfolders of a run, and the pictures in each."""
SKIPPED = {"checkpoints", "weights", "images", "masks", "depths"}
"""Folders without anything to show that may hold very much."""


@dataclass(frozen=True)
class Folder:
    """One run: its name below the searched folder, and the figures that lie in it, by subfolder."""

    path: Path
    name: str
    figures: dict[str, list[Path]] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """All that a page shows, in the order of the folders' names."""

    runs: list[Folder]
    predictions: list[Folder]


def find(folder: Path, out: Path) -> Found:
    """Search a folder and all below it, except where the page goes.

    Raises:
        CompleteSplatError: there is no such folder, or nothing to show in it.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    found = Found([], [])
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name not in SKIPPED and not name.startswith("."))
        path = Path(place)
        if path.resolve() == out.resolve():
            continue
        name = folder.resolve().name if path == folder else path.relative_to(folder).as_posix()
        if SCENE in files:
            found.predictions.append(Folder(path, name))
        elif RECORD in files or "multirun.yaml" in files or {*ROWS, "metrics.json", "hidden_modes.json"} & {*files}:
            figures = {part: sorted((path / part).glob(pattern)) for part, pattern in FIGURES.items()}
            run = Folder(path, name, {part: paths for part, paths in figures.items() if paths})
            if run.figures or {*ROWS, "metrics.json", "hidden_modes.json"} & {*files}:
                found.runs.append(run)
    if not found.runs and not found.predictions:
        raise CompleteSplatError(
            f"runs={folder}: nothing to show in it or below it; `completesplat fit`, `test`, `predict` and `report` "
            "write what a page is made of"
        )
    return found


def origin(path: Path, levels: int = 1) -> dict[str, str]:
    """Command, date and commit of what lies in a folder, as far as it or its parents (`levels` of them) say."""
    for place in [path, *path.parents[:levels]]:
        record = read_object(place / RECORD)
        if record:
            command = record.get("command")
            return {
                "command": _command(command) if isinstance(command, list) else "",
                "started": str(record.get("started") or ""),
                "commit": str(record.get("commit") or ""),
            }
    return {"command": "", "started": "", "commit": ""}


def read_object(path: Path) -> dict[str, Any]:
    """A file of JSON with an object in it; an empty one where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _command(parts: Sequence[Any]) -> str:
    """As it could be typed: the first part is the program and its verb."""
    return " ".join([str(part) for part in parts[:1]] + [shlex.quote(str(part)) for part in parts[1:]])
