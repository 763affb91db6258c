"""RealEstate10K in pixelSplat's chunks: `<split>/NNNNNN.torch`, and `<split>/index.json` with each clip's file.

A chunk is a list of clips as dictionaries with key, url, timestamps int64 [view], cameras float32 [view 18] and images,
a list of JPEG files as uint8 tensors (`real_estate_10k_tools`, `src/convert.py`). Reading a chunk runs no code from it.
"""

import hashlib
import json
from collections.abc import Sequence
from os.path import isfile
from pathlib import Path
from typing import TypeGuard

import torch
from torch import Tensor

from completesplat.data.realestate10k.clips import CAMERA_NUMBERS, Clip, make_clip
from completesplat.data.validation import BadAnnotation, UnreadableFile, at, inside, read_json, refused_to, require_file
from completesplat.errors import DataError, TensorFileError
from completesplat.weights.checkpoint_reading import read_tensor_file

CHUNKS_IN_MEMORY = 2

Chunk = dict[str, dict[str, object]]


class ChunkedClips:
    """Clips of one folder whose chunks exist; at most two chunks (about 100 MB each) are in memory.

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
            with refused_to(self.refused.append), at(path, key):
                paths[key] = inside(folder, name)
        # `Path.is_file` raises if a name is too long.
        existing = {path for path in set(paths.values()) if isfile(path)}
        self.folder = folder
        self._files = {key: path for key, path in paths.items() if path in existing}
        self.keys = sorted(self._files, key=lambda key: (self._files[key], key))
        self.missing = sorted(paths.keys() - self._files.keys())
        self._loaded: dict[Path, Chunk] = {}

    def chunks(self, keys: Sequence[str]) -> list[list[int]]:
        """Group the indices of `keys` by chunk."""
        members: dict[Path, list[int]] = {}
        for number, key in enumerate(keys):
            members.setdefault(self._files[key], []).append(number)
        return list(members.values())

    def clip(self, key: str) -> Clip:
        """Return a clip from its chunk, which is read unless it is in memory; refuse an unreadable chunk or clip."""
        path = self._files[key]
        with at(path, key):
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
        self._loaded[path] = self._loaded.pop(path) if path in self._loaded else read_chunk(path)
        return self._loaded[path]


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
    if not isinstance(content, list) or not all(isinstance(e, dict) and isinstance(e.get("key"), str) for e in content):
        raise BadAnnotation("not a list of clips with keys", str(path))
    chunk = {entry["key"]: entry for entry in content}
    if len(chunk) < len(content):
        raise BadAnnotation("several clips with the same key", str(path))
    return chunk


def _clip_from_entry(path: Path, key: str, entry: dict[str, object]) -> Clip:
    images, times, rows = entry.get("images"), entry.get("timestamps"), entry.get("cameras")
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
