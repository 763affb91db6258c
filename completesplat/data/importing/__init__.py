"""Own captures, written in CO3D v2's layout: undistorted pictures, masks, cameras and, where known, points."""

import logging
import re
import shlex
import shutil
from pathlib import Path

from completesplat.data.importing.capture import Capture
from completesplat.data.importing.colmap import read_colmap
from completesplat.data.importing.layout import SUBSET, CaptureWriter, Written
from completesplat.data.importing.transforms_json import read_transforms
from completesplat.errors import CompleteSplatError, DataError

logger = logging.getLogger(__name__)


def import_capture(
    out: Path | str,
    category: str | None,
    transforms: Path | str | None = None,
    colmap: Path | str | None = None,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    sequence: str | None = None,
    hold_out: int = 8,
    quality: int = 95,
    most_missing: float = 0.5,
    progress: bool = True,
) -> Path:
    """Write a capture to `out`/`category`, as the only sequence of a category; all of it or nothing.

    Args:
        transforms: a `transforms.json`; or
        colmap: the folder of a COLMAP model, with `images`, and `masks` if there are any.
        sequence: its name; by default that of the folder the capture lies in.
        hold_out: one of every `hold_out` frames goes to validation and test, the others to training. Small captures
            hold out more often, so that there are two.
        quality: of JPEG files that are written anew.
        most_missing: largest share of the frames of a `transforms.json` that may have no picture; they are left out.

    Returns:
        The category's folder.

    Raises:
        CompleteSplatError: settings that do not go together, or pycolmap is missing.
        DataError: something of the capture is missing, malformed or impossible, or the folder exists.
    """
    if (transforms is None) == (colmap is None):
        raise CompleteSplatError("give either transforms=FILE or colmap=FOLDER images=FOLDER")
    if (images is None) != (colmap is None) or (masks is not None and colmap is None):
        raise CompleteSplatError(
            "colmap=FOLDER goes with images=FOLDER (and masks=FOLDER), transforms=FILE with neither"
        )
    _check_numbers(hold_out, quality, most_missing)
    if category is None:
        raise CompleteSplatError("category is needed: give category=NAME")
    folder = Path(out) / _plain("category", str(category))
    if folder.exists():
        raise DataError("is there already: remove it or choose another category", str(folder))
    if sequence is not None:
        _plain("sequence", str(sequence))
    capture = _read(transforms, colmap, images, masks, most_missing)
    name = str(sequence) if sequence is not None else _made_plain(capture.name)
    written = _write_whole(folder, name, capture, hold_out, quality, progress)
    _report(folder, name, written)
    return folder


def _check_numbers(hold_out: int, quality: int, most_missing: float) -> None:
    if hold_out < 2 or not 1 <= quality <= 100:
        raise CompleteSplatError(f"hold_out must be at least 2 and quality 1 to 100, not {hold_out} and {quality}")
    if not 0 <= most_missing <= 1:
        raise CompleteSplatError(f"most_missing={most_missing:g}: must lie between 0 and 1")


def _read(
    transforms: Path | str | None,
    colmap: Path | str | None,
    images: Path | str | None,
    masks: Path | str | None,
    most_missing: float,
) -> Capture:
    if colmap is not None and images is not None:
        return read_colmap(Path(colmap), Path(images), None if masks is None else Path(masks))
    return read_transforms(Path(str(transforms)), most_missing)


def _write_whole(folder: Path, sequence: str, capture: Capture, hold_out: int, quality: int, progress: bool) -> Written:
    # Everything is made beside the final place, so that an interrupted import leaves no half category behind.
    unfinished = folder.parent / f".{folder.name}.unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        written = CaptureWriter(unfinished, folder.name, sequence, quality).write(capture, hold_out, progress)
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return written


def _plain(what: str, name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", name):
        raise CompleteSplatError(f"{what} must be a folder name of letters, digits, '_', '-' and '.', not {name!r}")
    return name


def _made_plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name).lstrip(".-") or "capture"


def _report(folder: Path, sequence: str, written: Written) -> None:
    logger.info(
        "%s: sequence %s, %d pictures (%d copied as they are, %d written anew), %d to train, %d to validate and test",
        folder,
        sequence,
        written.frames,
        written.copied,
        written.frames - written.copied,
        written.frames - written.held_out,
        written.held_out,
    )
    logger.info("point cloud: %s", f"{written.points} points" if written.points else "none")
    root = shlex.quote(f"data.root={folder.parent}")
    # A capture is one sequence, some of whose frames are held out.
    lists = f"data.subset={SUBSET} data.allow_shared_sequences=true"
    data = f"data=co3d_category {root} data.category={folder.name} {lists}"
    logger.info("to look at it:  completesplat data show %s", data)
    logger.info(
        "to train on it: completesplat fit experiment=toy_var %s data.batch_size=8 data.references_per_sequence=64",
        data,
    )


__all__ = ["import_capture"]
