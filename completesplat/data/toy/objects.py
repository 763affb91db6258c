"""Writes toy objects as a category in CO3D v2's layout, with every file that its reader expects."""

import gzip
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from completesplat.data.toy.co3d_files import CATEGORY, write_sequence
from completesplat.data.toy.scene import draw_scene
from completesplat.data.toy.writing import in_processes, write_once
from completesplat.errors import DataError

SUBSET = "fewview_train"
FORMAT_VERSION = 1

Annotations = tuple[str, list[dict[str, Any]], dict[str, Any]]


def write_objects(
    out: Path, scenes: int, frames: int, size: int, seed: int, workers: int | None = None, progress: bool = True
) -> Path:
    """Write `scenes` sequences of `frames` square pictures with masks, depth, point clouds and annotations.

    The bytes depend on `scenes`, `frames`, `size` and `seed` only, not on `workers` (processes; by default one a
    core). The subset `fewview_train` splits the sequences: about 85 % train, 5 % val, 10 % test. `<seq>/toy.json`
    tells the family and the colour of the patch on the back. A folder that holds the same set already is kept.

    Returns:
        The category's folder, `out`/toy_objects.

    Raises:
        DataError: a number that is too small, or a category folder with other content.
    """
    if scenes < 1 or frames < 2 or size < 8:
        raise DataError(f"toy objects need scenes >= 1, frames >= 2 and size >= 8, not {scenes}, {frames} and {size}")
    parameters = {"format": FORMAT_VERSION, "scenes": scenes, "frames": frames, "size": size, "seed": seed}

    def fill(category: Path) -> None:
        write = partial(_write_scene, category, frames, size, seed)
        written = in_processes(write, _splits(scenes), workers, "Rendering toy objects", progress)
        _write_lists(category, list(written))

    return write_once(out / CATEGORY, parameters, fill, progress)


def _splits(scenes: int) -> list[str]:
    """The split of every sequence, in order: at least one each from three scenes on."""
    test = max(1, round(0.1 * scenes)) if scenes > 1 else 0
    val = max(1, round(0.05 * scenes)) if scenes > 2 else 0
    return ["train"] * (scenes - val - test) + ["val"] * val + ["test"] * test


def _write_scene(category: Path, frames: int, size: int, seed: int, index: int, split: str) -> Annotations:
    """One sequence, from a random generator of its own; returns its split and annotations."""
    scene = draw_scene(np.random.default_rng([seed, index]), frames)
    name = f"{index:05d}_{scene.family}"
    frame_annotations, sequence_annotation = write_sequence(category, name, scene, size, split)
    hidden = {"family": scene.family, "patch_color": scene.patch_color}
    (category / name / "toy.json").write_text(json.dumps(hidden) + "\n")
    return split, frame_annotations, sequence_annotation


def _write_lists(category: Path, written: list[Annotations]) -> None:
    """Annotations of the category and its set list: [sequence, frame number, picture] of each split's frames."""
    lists: dict[str, list[list[Any]]] = {"train": [], "val": [], "test": []}
    for split, frames, _ in written:
        lists[split] += [[f["sequence_name"], f["frame_number"], f["image"]["path"]] for f in frames]
    _write_jgz(category / "frame_annotations.jgz", [frame for _, frames, _ in written for frame in frames])
    _write_jgz(category / "sequence_annotations.jgz", [sequence for _, _, sequence in written])
    (category / "set_lists").mkdir()
    (category / "set_lists" / f"set_lists_{SUBSET}.json").write_text(json.dumps(lists))


def _write_jgz(path: Path, content: list[dict[str, Any]]) -> None:
    # A fixed time stamp and no file name in the gzip header: equal content gives equal bytes.
    path.write_bytes(gzip.compress(json.dumps(content).encode(), mtime=0))
