"""Which clips of RealEstate10K are tested, and on which views: evaluation indices and lists of clips."""

from pathlib import Path
from typing import Any, NamedTuple

from completesplat.data.checks import BadAnnotation, UnreadableFile, read_json, require_file


class ChosenClips(NamedTuple):
    """Clips to test.

    Attributes:
        keys: the clips, in the order of the data.
        views: (reference, targets) by key, where an evaluation index gives them.
        left_out: how many clips were left out, by reason.
    """

    keys: list[str]
    views: dict[str, tuple[int, list[int]]] | None
    left_out: dict[str, int]


def choose_clips(keys: list[str], evaluation_index: Path | None, scene_list: Path | None) -> ChosenClips:
    """Of the clips that are there, those which both files name (all, without files).

    Args:
        evaluation_index: pixelSplat's, {key: {"context": [i, j], "target": [...]} or null}: the first context frame is
            the reference; clips with null are not tested (`assets/evaluation_index_re10k.json`).
        scene_list: one key a line.

    Raises:
        DataError: a file that is missing or malformed.
    """
    views: dict[str, tuple[int, list[int]]] | None = None
    left_out: dict[str, int] = {}
    there = set(keys)
    if evaluation_index is not None:
        index = read_json(evaluation_index)
        if not isinstance(index, dict):
            raise BadAnnotation("not a table of clips", str(evaluation_index))
        views = {key: _views(evaluation_index, key, entry) for key, entry in index.items() if entry is not None}
        left_out["null in the index"] = len(index) - len(views)
        left_out["in the index, not in the data"] = len(views.keys() - there)
        left_out["not in the index"] = len(there - index.keys())
        keys = [key for key in keys if key in views]
    if scene_list is not None:
        listed = set(_lines(scene_list))
        left_out["in the list, not in the data"] = len(listed - there)
        left_out["not in the list"] = len(set(keys) - listed)
        keys = [key for key in keys if key in listed]
    return ChosenClips(keys, views, left_out)


def _views(path: Path, key: str, entry: Any) -> tuple[int, list[int]]:
    views: list[Any] = [entry.get(role) for role in ("context", "target")] if isinstance(entry, dict) else [None]
    for frames in views:
        if not isinstance(frames, list) or not frames or not all(type(f) is int and f >= 0 for f in frames):
            raise BadAnnotation("context and target must be lists of frame numbers", str(path), key)
    context, targets = views
    return context[0], targets


def _lines(path: Path) -> list[str]:
    try:
        return require_file(path).read_text(encoding="utf-8").split()
    except UnicodeDecodeError:
        raise UnreadableFile("not a text file", str(path)) from None
