"""RealEstate10K as it is published: `<split>/<key>.txt` beside the frames `<split>/<key>/<timestamp>.jpg` (or .png).

Line 0 of a text is the video's address; every other line is a timestamp in microseconds and a camera's 18 numbers.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from completesplat.data.checks import BadAnnotation, MissingFile, UnreadableFile, at, require_file
from completesplat.data.realestate10k_clips import CAMERA_NUMBERS, Clip, clip_cameras, picture_size
from completesplat.data.transforms import Square, read_square
from completesplat.errors import DataError

PICTURES = (".png", ".jpg")
MOST_BYTES = 2**26  # a frame needs some 300


class TextClips:
    """The clips of one folder whose frames are there.

    Attributes:
        keys: names of the clips, sorted.
        missing: the clips without a folder of frames.
        refused: nothing, as clips are looked at when they are read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with os.scandir(folder) as entries:
            folders = {entry.name: _is_folder(entry) for entry in entries}
        texts = sorted(name.removesuffix(".txt") for name in folders if name.endswith(".txt"))
        self.keys = [key for key in texts if folders.get(key)]
        self.missing = [key for key in texts if not folders.get(key)]
        self.refused: list[DataError] = []

    def chunks(self, keys: Sequence[str]) -> list[list[int]]:
        """Numbers of the clips that are best read together: clips are files of their own, so any will do."""
        return [list(range(len(keys)))]

    def clip(self, key: str) -> Clip:
        """Read a clip's text and list its frames.

        Raises:
            DataError: it is malformed, or a frame is missing.
        """
        path = self.folder / f"{key}.txt"
        with at(path, key):
            timestamps, rows = _read_text(path)
            pictures = _pictures(self.folder / key)
            for frame, time in enumerate(timestamps):
                if time not in pictures:
                    raise MissingFile(
                        "no picture with this timestamp", str(self.folder / key / f"{time}.jpg"), key, frame
                    )
            paths = [pictures[time] for time in timestamps]
            with at(frame=0):
                size = picture_size(paths[0], str(paths[0])) if paths else (1, 1)
            numbers = torch.tensor(rows, dtype=torch.float64).reshape(-1, CAMERA_NUMBERS)
            return Clip(key, path, timestamps, clip_cameras(numbers, timestamps, size), partial(_read, paths, size))

    def fingerprint(self) -> str:
        """SHA-256 of the texts' names and sizes (there are tens of thousands)."""
        texts = {key: self.folder / f"{key}.txt" for key in self.keys}
        sizes = [(key, text.stat().st_size if text.is_file() else None) for key, text in texts.items()]
        return hashlib.sha256(json.dumps(sizes).encode()).hexdigest()


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a ring of links
        return False


def _read_text(path: Path) -> tuple[tuple[int, ...], list[list[float]]]:
    """Timestamps and camera rows."""
    timestamps, rows = [], []
    try:
        with require_file(path).open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise UnreadableFile(f"more than {MOST_BYTES:,} bytes")
        lines = content.decode("utf-8").splitlines()[1:]
    except (OSError, UnicodeDecodeError) as error:
        raise UnreadableFile(f"not a text file ({type(error).__name__})") from None
    for frame, columns in enumerate(line.split() for line in lines if line.strip()):
        with at(frame=frame):
            if len(columns) != 1 + CAMERA_NUMBERS:
                raise BadAnnotation(f"{len(columns)} columns instead of {1 + CAMERA_NUMBERS}")
            try:
                timestamps.append(int(columns[0]))
                rows.append([float(column) for column in columns[1:]])
            except ValueError as error:
                raise BadAnnotation(str(error)) from None
    return tuple(timestamps), rows


def _pictures(folder: Path) -> dict[int, Path]:
    """Files by timestamp, JPEG before PNG."""
    with os.scandir(folder) as entries:
        paths = [Path(entry.path) for entry in entries]
    ordered = sorted((path for path in paths if path.suffix in PICTURES), key=lambda path: PICTURES.index(path.suffix))
    return {int(path.stem): path for path in ordered if path.stem.isdecimal()}


def _read(
    paths: list[Path], image_size: tuple[int, int], frame: int, square: Square, size: int
) -> UInt8[Tensor, "3 size size"]:
    return read_square(paths[frame], image_size, square, size, "RGB")
