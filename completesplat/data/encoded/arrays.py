"""`.npy` files that are written row by row, their number of rows unknown until the end, and read memory-mapped."""

import os
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Shaped

from completesplat.data.checks import ChangedFile, UnreadableFile, at, require_file
from completesplat.data.encoded.manifest import Array


class ArrayWriter:
    """Writes rows of one shape behind each other; leaving the context puts their number into the header.

    After an exception the file is removed.

    Args:
        row: shape of a row.
    """

    def __init__(self, path: Path, row: tuple[int, ...], dtype: str) -> None:
        self.path = path
        self.row = row
        self.dtype = np.dtype(dtype)
        self.count = 0

    def __enter__(self) -> "ArrayWriter":
        self._file = self.path.open("wb")
        self._begin = self._write_header()
        return self

    def append(self, rows: Shaped[np.ndarray, "_ _ _ _"]) -> None:
        """Some more rows, of the writer's dtype."""
        assert (rows.shape[1:], rows.dtype) == (self.row, self.dtype)
        self._file.write(np.ascontiguousarray(rows).data)
        self.count += len(rows)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with self._file:
            self._file.seek(0)
            # NumPy pads headers so that a first axis of any length fits.
            assert self._write_header() == self._begin
            self._file.flush()
            os.fsync(self._file.fileno())
        if error is not None:
            self.path.unlink()

    def _write_header(self) -> int:
        header = {"descr": self.dtype.str, "fortran_order": False, "shape": (self.count, *self.row)}
        np.lib.format.write_array_header_1_0(self._file, header)
        return self._file.tell()

    def described(self) -> Array:
        """For the manifest."""
        return Array(self.path.name, self.dtype.name, (self.count, *self.row))


def open_array(root: Path, array: Array) -> np.memmap:
    """A stored array; nothing of it is read yet.

    Raises:
        DataError: missing, cut short, or with another shape or type than the manifest says.
    """
    path = require_file(root / array.file)
    with at(file=path):
        try:
            found = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise UnreadableFile(f"damaged or no NumPy array: encode the pictures again ({error})") from None
        if not isinstance(found, np.memmap) or found.shape != array.shape or found.dtype.name != array.dtype:
            raise ChangedFile("not the array that the manifest describes: encode the pictures again")
        if path.stat().st_size != found.offset + found.nbytes:
            raise ChangedFile("longer than it was written: encode the pictures again")
        return found
