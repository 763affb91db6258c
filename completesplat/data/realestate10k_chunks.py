"""RealEstate10K in pixelSplat's chunks: `<split>/NNNNNN.torch` and `<split>/index.json` with each clip's file.

A chunk is a list of clips as dictionaries: key, url, timestamps int64 [view], cameras float32 [view 18], images (a list
of JPEG files as uint8 tensors) (`real_estate_10k_tools`, `src/convert.py`). Chunks are read without running code.
"""

import io
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from completesplat.data.checks import inside, read_json, require_file
from completesplat.data.images import decode
from completesplat.data.realestate10k_clips import CAMERA_NUMBERS, Clip, clip_cameras, picture_size
from completesplat.data.transforms import Square, cut_square
from completesplat.errors import DataError

CHUNKS_IN_MEMORY = 2

Chunk = dict[str, dict[str, Any]]


class ChunkedClips:
    """The clips of one folder whose chunk is there; at most two chunks (of about 100 MB) are in memory.

    Attributes:
        keys: names of the clips, in the order of their files.
        missing: how many clips lie in a chunk that is not there.

    Raises:
        DataError: the index is missing or malformed, or leads elsewhere.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / "index.json"
        index = read_json(path)
        if not isinstance(index, dict) or not all(isinstance(name, str) for name in index.values()):
            raise DataError(f"{path} is not a table of keys and files")
        there = {name: inside(folder, name).is_file() for name in set(index.values())}
        self._files = {key: folder / name for key, name in index.items() if there[name]}
        self.keys = sorted(self._files, key=lambda key: (self._files[key], key))
        self.missing = len(index) - len(self.keys)
        self._loaded: dict[Path, Chunk] = {}

    def chunks(self, keys: list[str]) -> list[list[int]]:
        """Numbers of the clips that lie in one file, for all files."""
        members: dict[Path, list[int]] = {}
        for number, key in enumerate(keys):
            members.setdefault(self._files[key], []).append(number)
        return list(members.values())

    def clip(self, key: str) -> Clip:
        """A clip, from the chunk in memory or on disk.

        Raises:
            DataError: the chunk cannot be read, does not hold the clip, or holds a malformed one.
        """
        path = self._files[key]
        chunk = self._chunk(path)
        if key not in chunk:
            raise DataError(f"{path} does not hold clip {key}, which index.json says it does")
        return _clip_from_entry(path, key, chunk[key])

    def _chunk(self, path: Path) -> Chunk:
        chunk = self._loaded.pop(path, None)
        if chunk is None:
            # The least recently used one goes before the next one comes, so that there are never three.
            while len(self._loaded) >= CHUNKS_IN_MEMORY:
                del self._loaded[next(iter(self._loaded))]
            chunk = read_chunk(path)
        self._loaded[path] = chunk
        return chunk


def read_chunk(path: Path) -> Chunk:
    """The clips of a file by key, as they are stored.

    Raises:
        DataError: no chunk, one that is damaged or would run code, one that is much larger than its file, or clips with
            the same key.
    """
    try:
        with zipfile.ZipFile(require_file(path)) as archive:
            size = sum(record.file_size for record in archive.infolist())
        # torch.save compresses nothing, so a chunk that says it is larger than its file was made to fill the memory.
        content = torch.load(path, map_location="cpu", weights_only=True) if size <= path.stat().st_size else None
    except DataError:
        raise
    except Exception as error:  # the unpickler's refusals have no common class
        raise DataError(f"{path} is not a chunk that can be read safely ({type(error).__name__})") from None
    if not isinstance(content, list) or not all(isinstance(e, dict) and isinstance(e.get("key"), str) for e in content):
        raise DataError(f"{path} is not a list of clips with keys")
    chunk = {entry["key"]: entry for entry in content}
    if len(chunk) < len(content):
        raise DataError(f"{path} holds several clips with the same key")
    return chunk


def _clip_from_entry(path: Path, key: str, entry: dict[str, Any]) -> Clip:
    where = f"{path}, clip {key}"
    images, times, rows = entry.get("images"), entry.get("timestamps"), entry.get("cameras")
    if not isinstance(images, list) or not all(_is_bytes(image) for image in images):
        raise DataError(f"{where}: images are not a list of JPEG files (uint8)")
    if not isinstance(rows, Tensor) or not rows.is_floating_point() or rows.shape[1:] != (CAMERA_NUMBERS,):
        raise DataError(f"{where}: cameras are not {CAMERA_NUMBERS} columns of floats")
    if not isinstance(times, Tensor) or times.dtype != torch.int64 or times.ndim != 1:
        raise DataError(f"{where}: timestamps are not int64")
    if not len(images) == len(rows) == len(times):
        raise DataError(f"{where}: {len(images)} images, {len(rows)} cameras and {len(times)} timestamps")
    size = picture_size(io.BytesIO(images[0].numpy().tobytes()), f"{where}, frame 0") if images else (1, 1)
    timestamps = tuple(times.tolist())
    return Clip(key, path, timestamps, clip_cameras(rows, timestamps, size, where), partial(_read, images, size, where))


def _is_bytes(image: Any) -> bool:
    return isinstance(image, Tensor) and image.dtype == torch.uint8 and image.ndim == 1 and image.is_contiguous()


def _read(
    images: list[Tensor], image_size: tuple[int, int], where: str, frame: int, square: Square, size: int
) -> UInt8[Tensor, "3 size size"]:
    image = decode(images[frame].numpy().tobytes(), f"{where}, frame {frame}", "RGB", image_size)
    return cut_square(image, square, size)
