"""Clips of RealEstate10K, as text files beside folders of frames or in pixelSplat's chunks.

Chunks are `<split>/NNNNNN.torch`; `<split>/index.json` names each clip's chunk. A chunk is a list of clips as
dictionaries with key, url, timestamps int64 [view], cameras float32 [view 18] and images, a list of JPEG files as uint8
tensors (`real_estate_10k_tools`, `src/convert.py`). Reading a chunk runs no code from it.
"""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from os.path import isdir, isfile
from pathlib import Path
from typing import NamedTuple, TypeGuard

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from completesplat.data.validation import LARGEST, ROTATION_TOLERANCE, path_below, read_json, read_text, require_file
from completesplat.errors import (
    BadAnnotation,
    BadCamera,
    DataError,
    MissingFile,
    TensorFileError,
    TooFewFrames,
    UnreadableFile,
    errors_at,
    refused_to,
)
from completesplat.geometry.cameras import Cameras
from completesplat.photo.crop import Square, cut_square
from completesplat.photo.files import decode_image, stored_size
from completesplat.weights.checkpoint_reading import read_tensor_file

CAMERA_NUMBERS = 18
FORMATS = ("JPEG", "PNG")
SUFFIXES = (".png", ".jpg", ".jpeg")
MOST_BYTES = 2**26  # a frame needs about 300
CHUNKS_IN_MEMORY = 2

Chunk = dict[str, dict[str, object]]
Images = Sequence[Path] | Sequence[UInt8[Tensor, " _"]]


class Clip(NamedTuple):
    """Frames of a clip, in order.

    Attributes:
        source: the file that holds the cameras.
        cameras: [view], float64, in pixels of the stored images and in the clip's own units of length.
        images: image files, or their bytes in the file `source`.
    """

    key: str
    source: Path
    cameras: Cameras
    images: Images

    def read(self, frame: int, square: Square, size: int) -> UInt8[Tensor, "3 {size} {size}"]:
        """Return the square part of a frame's image, resized to `size`."""
        stored = _stored(self.images[frame], self.source)
        image = decode_image(*stored, "RGB", self.cameras.image_size)
        return cut_square(image, square, size)


def make_clip(key: str, source: Path, timestamps: Sequence[int], rows: Float[Tensor, "_ 18"], images: Images) -> Clip:
    """Convert stored rows and images to a clip, of which the first image determines the size.

    Raises:
        TooFewFrames: there are fewer than two frames.
        BadAnnotation: timestamps repeat, or numbers are not finite.
        BadCamera: a focal length is not positive, the lens has distortion, or a pose is not rigid.
        BadImage: the first image is unusable.
    """
    if len(rows) < 2:
        raise TooFewFrames(f"{len(rows)} frames, at least two are needed")
    with errors_at(frame=0):
        size = stored_size(*_stored(images[0], source), FORMATS)
    rows = rows.double()
    count = Counter(timestamps)
    world_to_camera = rows[:, 6:].reshape(-1, 3, 4)
    rotation = world_to_camera[:, :, :3]
    deviation = (rotation @ rotation.mT - torch.eye(3, dtype=rows.dtype)).abs().amax(dim=(1, 2))
    rigid = (deviation <= ROTATION_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    repeated = torch.tensor([count[time] > 1 for time in timestamps])
    infinite = ~(rows.abs() < LARGEST).all(dim=1)
    _refuse_frames(repeated, BadAnnotation, "another frame has its timestamp")
    _refuse_frames(infinite, BadAnnotation, "camera with numbers that are not finite in float32")
    _refuse_frames((rows[:, :2] <= 0).any(dim=1), BadCamera, "focal length is not positive")
    _refuse_frames((rows[:, 4:6] != 0).any(dim=1), BadCamera, "lens distortion is not supported")
    _refuse_frames(~rigid, BadCamera, "pose is not a rotation and translation")
    intrinsics = torch.eye(3, dtype=rows.dtype).repeat(len(rows), 1, 1)
    pose = torch.eye(4, dtype=rows.dtype).repeat(len(rows), 1, 1)
    sides = rows.new_tensor(size[::-1])
    intrinsics[:, [0, 1], [0, 1]] = rows[:, :2] * sides
    intrinsics[:, :2, 2] = rows[:, 2:4] * sides
    pose[:, :3] = world_to_camera
    return Clip(key, source, Cameras(pose, intrinsics, size), images)


def _refuse_frames(bad: Bool[Tensor, " view"], kind: type[DataError], reason: str) -> None:
    """Refuse a clip with bad frames, and name the first of them."""
    if bad.any():
        raise kind(reason, frame=int(bad.nonzero()[0]))


def _stored(image: Path | Tensor, source: Path) -> tuple[Path | bytes, str]:
    """Return an image's file or content, and the file to name in errors."""
    if isinstance(image, Path):
        return image, str(image)
    return image.numpy().tobytes(), str(source)


class TextClips:
    """Clips of one folder that have a folder of frames. `missing` names the clips without one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries]
        texts = sorted(name.removesuffix(".txt") for name in names if name.endswith(".txt"))
        folders = {key for key in set(texts).intersection(names) if isdir(folder / key)}
        self.keys = [key for key in texts if key in folders]
        self.missing = [key for key in texts if key not in folders]
        self.refused: list[DataError] = []

    def chunks(self, keys: Sequence[str]) -> list[list[int]]:
        """Group all clips together, because each has its own files and any reading order is fast."""
        return [list(range(len(keys)))]

    def clip(self, key: str) -> Clip:
        """Read a clip's text file and list its frames, or refuse a malformed text file or a missing frame."""
        path = self.folder / f"{key}.txt"
        with errors_at(path, key):
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
        sizes: list[tuple[str, int | None]] = []
        for key in self.keys:
            text = self.folder / f"{key}.txt"
            sizes.append((key, text.stat().st_size if text.is_file() else None))
        return hashlib.sha256(json.dumps(sizes).encode()).hexdigest()


def _read_text(path: Path) -> tuple[tuple[int, ...], list[list[float]]]:
    """Return timestamps and camera rows. Above them is the video's address, which some copies lack."""
    timestamps = []
    rows = []
    lines = [line.split() for line in read_text(path, MOST_BYTES).splitlines() if line.strip()]
    if lines and len(lines[0]) == 1:
        del lines[0]
    for frame, columns in enumerate(lines):
        with errors_at(frame=frame):
            if len(columns) != 1 + CAMERA_NUMBERS:
                raise BadAnnotation(f"{len(columns)} columns instead of {1 + CAMERA_NUMBERS}")
            try:
                timestamps.append(int(columns[0]))
                rows.append([float(column) for column in columns[1:]])
            except ValueError as error:
                raise BadAnnotation(str(error)) from None
    return tuple(timestamps), rows


def _images_of(folder: Path) -> dict[int, Path]:
    """Return image files by timestamp, where JPEG is preferred to PNG."""
    try:
        paths = list(folder.iterdir())
    except OSError as error:
        raise UnreadableFile(f"cannot be listed ({error.strerror})", str(folder)) from None
    images = [path for path in paths if path.suffix.lower() in SUFFIXES and path.stem.isdecimal()]
    png_first = sorted(images, key=lambda path: path.suffix.lower() != ".png")
    return {int(path.stem): path for path in png_first}


class ChunkedClips:
    """Clips of one folder whose chunks exist, with at most two chunks (about 100 MB each) in memory.

    Attributes:
        keys: names of the clips, in the order of their files.
        missing: names of the clips whose chunk is missing.
        refused: errors of index entries that lead outside of the folder.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / "index.json"
        index = read_json(path)
        if not isinstance(index, dict) or not all(isinstance(name, str) for name in index.values()):
            raise BadAnnotation("not a table of keys and files", str(path))
        self.refused: list[DataError] = []
        paths: dict[str, Path] = {}
        for key, name in index.items():
            with refused_to(self.refused.append, path, key):
                paths[key] = path_below(folder, name)
        # `Path.is_file` raises if a name is too long.
        existing = {path for path in set(paths.values()) if isfile(path)}
        self.folder = folder
        self._files = {key: path for key, path in paths.items() if path in existing}
        self.keys = sorted(self._files, key=lambda key: (self._files[key], key))
        self.missing = sorted(paths.keys() - self._files.keys())
        self._loaded: dict[Path, Chunk] = {}

    def chunks(self, keys: Sequence[str]) -> list[list[int]]:
        """Group clips by their chunks."""
        members: dict[Path, list[int]] = {}
        for number, key in enumerate(keys):
            members.setdefault(self._files[key], []).append(number)
        return list(members.values())

    def clip(self, key: str) -> Clip:
        """Return a clip from its chunk, which is read unless it is in memory, or refuse an unreadable chunk or clip."""
        path = self._files[key]
        with errors_at(path, key):
            chunk = self._chunk(path)
            if key not in chunk:
                raise BadAnnotation("the chunk does not hold this clip, which index.json says it does")
            return _clip_from_entry(path, key, chunk[key])

    def fingerprint(self) -> str:
        """Return the SHA-256 of the index and of the chunks' sizes."""
        sizes = sorted((path.name, path.stat().st_size) for path in set(self._files.values()))
        index = {key: path.name for key, path in sorted(self._files.items())}
        return hashlib.sha256(json.dumps([index, sizes]).encode()).hexdigest()

    def _chunk(self, path: Path) -> Chunk:
        if path not in self._loaded and len(self._loaded) >= CHUNKS_IN_MEMORY:
            # Delete the least recently used chunk before reading the next one, so that there are never three.
            del self._loaded[next(iter(self._loaded))]
        chunk = self._loaded.pop(path) if path in self._loaded else read_chunk(path)
        self._loaded[path] = chunk  # the last one, as the most recently used
        return chunk


def read_chunk(path: Path) -> Chunk:
    """Read the clips of a chunk by key, as they are stored.

    Raises:
        MissingFile: the file does not exist.
        UnreadableFile: the file is no chunk, is damaged, would run code, or unpacks to more than its own size.
        BadAnnotation: the content is not a list of clips, or clips have the same key.
    """
    require_file(path)
    try:
        content = read_tensor_file(path)
    except TensorFileError as error:
        raise UnreadableFile(f"not a chunk that can be read safely ({error})", str(path)) from None
    if not isinstance(content, list) or not all(map(_has_key, content)):
        raise BadAnnotation("not a list of clips with keys", str(path))
    chunk = {entry["key"]: entry for entry in content}
    if len(chunk) < len(content):
        raise BadAnnotation("several clips with the same key", str(path))
    return chunk


def _has_key(entry: object) -> bool:
    return isinstance(entry, dict) and isinstance(entry.get("key"), str)


def _clip_from_entry(path: Path, key: str, entry: dict[str, object]) -> Clip:
    """Check an entry of a chunk and return its clip."""
    images = entry.get("images")
    times = entry.get("timestamps")
    rows = entry.get("cameras")
    if not isinstance(images, list) or not all(_is_bytes(image) for image in images):
        raise BadAnnotation("images are not a list of JPEG files (uint8)")
    if not _is_plain(rows) or not rows.is_floating_point() or rows.shape[1:] != (CAMERA_NUMBERS,):
        raise BadAnnotation(f"cameras are not {CAMERA_NUMBERS} columns of floats")
    if not _is_plain(times) or times.dtype != torch.int64 or times.ndim != 1:
        raise BadAnnotation("timestamps are not int64")
    if not len(images) == len(rows) == len(times):
        raise BadAnnotation(f"{len(images)} images, {len(rows)} cameras and {len(times)} timestamps")
    return make_clip(key, path, times.tolist(), rows, images)


def _is_bytes(image: object) -> TypeGuard[Tensor]:
    return _is_plain(image) and image.dtype == torch.uint8 and image.ndim == 1 and image.is_contiguous()


def _is_plain(value: object) -> TypeGuard[Tensor]:
    """Return whether a value is a dense CPU tensor that is not part of an autograd graph."""
    if not isinstance(value, Tensor) or value.layout != torch.strided:
        return False
    return value.device.type == "cpu" and not value.requires_grad
