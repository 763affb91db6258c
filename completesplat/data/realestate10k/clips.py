"""Clips of RealEstate10K in any form, and clips stored as text files beside folders of frames."""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.data.images.crop import Square, cut_square
from completesplat.data.images.files import decode, stored_size
from completesplat.data.validation import (
    ROTATION_TOLERANCE,
    BadAnnotation,
    BadCamera,
    MissingFile,
    TooFewFrames,
    at,
    read_text,
)
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras

CAMERA_NUMBERS = 18
FORMATS = ("JPEG", "PNG")
SUFFIXES = (".png", ".jpg")
MOST_BYTES = 2**26  # a frame needs about 300


@dataclass(frozen=True)
class Clip:
    """Frames of a clip, in order.

    Attributes:
        source: the file that holds the cameras.
        cameras: [view], float64, in pixels of the stored images and in the clip's own units of length.
        images: image files, or their bytes in the file `source`.
    """

    key: str
    source: Path
    cameras: Cameras
    images: Sequence[Path] | Sequence[UInt8[Tensor, " _"]]

    def read(self, frame: int, square: Square, size: int) -> UInt8[Tensor, "3 {size} {size}"]:
        """Return the square part of a frame's image, resized to `size`."""
        return cut_square(
            decode(*_stored(self.images[frame], self.source), "RGB", self.cameras.image_size), square, size
        )


def make_clip(
    key: str,
    source: Path,
    timestamps: Sequence[int],
    rows: Float[Tensor, "view 18"],
    images: Sequence[Path] | Sequence[UInt8[Tensor, " _"]],
) -> Clip:
    """Return the clip of stored rows and images; the first image determines the size. Errors as in `clip_cameras`."""
    with at(frame=0):
        size = stored_size(*_stored(images[0], source), FORMATS) if images else (1, 1)
    return Clip(key, source, clip_cameras(rows, timestamps, size), images)


def _stored(image: Path | Tensor, source: Path) -> tuple[Path | bytes, str]:
    """Return an image's file or content, and the file to name in errors."""
    return (image, str(image)) if isinstance(image, Path) else (image.numpy().tobytes(), str(source))


def clip_cameras(rows: Float[Tensor, "view 18"], timestamps: Sequence[int], image_size: tuple[int, int]) -> Cameras:
    """Convert stored rows to cameras [view] (float64) for images of (height, width).

    Raises:
        TooFewFrames: there are fewer than two frames.
        BadAnnotation: timestamps repeat, or numbers are not finite.
        BadCamera: a focal length is not positive, the lens has distortion, or a pose is not rigid.
    """
    if len(rows) < 2:
        raise TooFewFrames(f"{len(rows)} frames, at least two are needed")
    rows, count = rows.double(), Counter(timestamps)
    world_to_camera = rows[:, 6:].reshape(-1, 3, 4)
    rotation = world_to_camera[:, :, :3]
    deviation = (rotation @ rotation.mT - torch.eye(3, dtype=rows.dtype)).abs().amax(dim=(1, 2))
    rigid = (deviation <= ROTATION_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    for bad, kind, reason in (
        (torch.tensor([count[time] > 1 for time in timestamps]), BadAnnotation, "another frame has its timestamp"),
        (~rows.isfinite().all(dim=1), BadAnnotation, "camera with numbers that are not finite"),
        ((rows[:, :2] <= 0).any(dim=1), BadCamera, "focal length is not positive"),
        ((rows[:, 4:6] != 0).any(dim=1), BadCamera, "lens distortion is not supported"),
        (~rigid, BadCamera, "pose is not a rotation and translation"),
    ):
        if bad.any():
            raise kind(reason, frame=int(bad.nonzero()[0]))
    intrinsics, pose = (torch.eye(n, dtype=rows.dtype).repeat(len(rows), 1, 1) for n in (3, 4))
    sides = rows.new_tensor(image_size[::-1])
    intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2] = rows[:, :2] * sides, rows[:, 2:4] * sides
    pose[:, :3] = world_to_camera
    return Cameras(pose, intrinsics, image_size)


class TextClips:
    """Clips of one folder that have a folder of frames; `missing` names the clips without one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with os.scandir(folder) as entries:
            folders = {entry.name: _is_folder(entry) for entry in entries}
        texts = sorted(name.removesuffix(".txt") for name in folders if name.endswith(".txt"))
        self.keys = [key for key in texts if folders.get(key)]
        self.missing = [key for key in texts if not folders.get(key)]
        self.refused: list[DataError] = []

    def chunks(self, keys: Sequence[str]) -> list[list[int]]:
        """Group all clips together, because each has its own files and any reading order is fast."""
        return [list(range(len(keys)))]

    def clip(self, key: str) -> Clip:
        """Read a clip's text file and list its frames; refuse a malformed text file or a missing frame."""
        path = self.folder / f"{key}.txt"
        with at(path, key):
            timestamps, rows = _read_text(path)
            images = _images_of(self.folder / key)
            for frame, time in enumerate(timestamps):
                if time not in images:
                    raise MissingFile("no such image", str(self.folder / key / f"{time}.jpg"), key, frame)
            paths = [images[time] for time in timestamps]
            numbers = torch.tensor(rows, dtype=torch.float64).reshape(-1, CAMERA_NUMBERS)
            return make_clip(key, path, timestamps, numbers, paths)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the text files' names and sizes (reading tens of thousands would be slow)."""
        texts = [(key, self.folder / f"{key}.txt") for key in self.keys]
        sizes = [(key, text.stat().st_size if text.is_file() else None) for key, text in texts]
        return hashlib.sha256(json.dumps(sizes).encode()).hexdigest()


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a ring of links
        return False


def _read_text(path: Path) -> tuple[tuple[int, ...], list[list[float]]]:
    """Return timestamps and camera rows."""
    timestamps, rows = [], []
    lines = read_text(path, MOST_BYTES).splitlines()[1:]
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


def _images_of(folder: Path) -> dict[int, Path]:
    """Return image files by timestamp; JPEG is preferred to PNG."""
    with os.scandir(folder) as entries:
        paths = [Path(entry.path) for entry in entries]
    ordered = sorted((path for path in paths if path.suffix in SUFFIXES), key=lambda path: SUFFIXES.index(path.suffix))
    return {int(path.stem): path for path in ordered if path.stem.isdecimal()}
