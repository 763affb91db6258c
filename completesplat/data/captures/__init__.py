"""Import of a user's captures into CO3D v2's layout: undistorted images, masks, cameras and, if known, points."""

import logging
import re
import shlex
from pathlib import Path
from typing import Annotated

from completesplat.data.captures.colmap import read_colmap
from completesplat.data.captures.layout import SUBSET, CaptureWriter, Written
from completesplat.data.captures.transforms_json import read_transforms
from completesplat.errors import CompleteSplatError, DataError
from completesplat.files import atomic_folder
from completesplat.settings.schema import Range, Share

logger = logging.getLogger(__name__)


def import_capture(
    out: Path | str,
    category: str | None,
    transforms: Path | str | None = None,
    colmap: Path | str | None = None,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    sequence: str | None = None,
    hold_out: Annotated[int, Range(2)] = 8,
    quality: Annotated[int, Range(1, 100)] = 95,
    most_missing: Share = 0.5,
    progress: bool = True,
) -> Path:
    """Write a capture atomically to `out`/`category`, as the only sequence of this category.

    Args:
        transforms: a `transforms.json`; or `colmap`, the folder of a COLMAP model, with `images` and perhaps `masks`.
        sequence: name of the sequence; by default that of the capture's folder.
        hold_out: one of every `hold_out` frames (at least two) is for validation and test, the others for training.
        quality: JPEG quality of images that are encoded again.
        most_missing: largest share of the frames of a `transforms.json` that may lack an image and are left out.

    Raises:
        CompleteSplatError: the settings contradict each other, or pycolmap is missing.
        DataError: something is missing, malformed or impossible, or the folder exists.
        DiskError: the disk is full.
    """
    if (transforms is None) == (colmap is None):
        raise CompleteSplatError("give either transforms=FILE or colmap=FOLDER images=FOLDER")
    if (images is None) != (colmap is None) or (masks is not None and colmap is None):
        raise CompleteSplatError("colmap=FOLDER goes with images=FOLDER (masks=FOLDER), transforms=FILE with neither")
    if category is None:
        raise CompleteSplatError("category is needed: give category=NAME")
    for what, chosen in {"category": category, "sequence": "capture" if sequence is None else sequence}.items():
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", str(chosen)):
            raise CompleteSplatError(f"{what} must be a name of letters, digits, '_', '-' and '.', not {chosen!r}")
    folder = Path(out) / str(category)
    if folder.exists():
        raise DataError("is there already: remove it or choose another category", str(folder))
    if colmap is not None and images is not None:
        capture = read_colmap(Path(colmap), Path(images), None if masks is None else Path(masks))
    else:
        capture = read_transforms(Path(str(transforms)), most_missing)
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", capture.name)
    name = str(sequence) if sequence is not None else plain.lstrip(".-") or "capture"
    with atomic_folder(folder) as unfinished:
        written = CaptureWriter(unfinished, folder.name, name, quality).write(capture, hold_out, progress)
    _report(folder, name, written)
    return folder


def _report(folder: Path, sequence: str, written: Written) -> None:
    files = f"{written.copied} copied as they are, {written.frames - written.copied} written anew"
    use = f"{written.frames - written.held_out} to train, {written.held_out} to validate and test"
    logger.info("%s: sequence %s, %d pictures (%s), %s", folder, sequence, written.frames, files, use)
    logger.info("point cloud: %s", f"{written.points} points" if written.points else "none")
    root, batches = shlex.quote(f"data.root={folder.parent}"), "data.batch_size=8 data.references_per_sequence=64"
    # All splits share the one sequence of a capture.
    lists = f"data.subset={SUBSET} data.allow_shared_sequences=true"
    data = f"data=co3d_category {root} data.category={folder.name} {lists}"
    logger.info("to look at it:  completesplat data show %s", data)
    logger.info("to train on it: completesplat fit experiment=toy_var %s %s", data, batches)
