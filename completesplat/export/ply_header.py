"""The header of a binary little-endian `.ply`, read without trusting any of its numbers."""

from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from completesplat.errors import PlyError

LONGEST_HEADER = 1 << 16
LONGEST_COUNT = 15  # digits
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


@dataclass(frozen=True)
class Element:
    """An element of the header: `count` records of type `dtype`."""

    name: str
    count: int
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Bytes that the records take."""
        return self.count * self.dtype.itemsize


def read_header(file: BinaryIO) -> tuple[list[Element], int]:
    """Elements in the order of the file, and the position where their data begin.

    Raises:
        PlyError: not a `.ply`, another format than binary little endian, list properties, or a broken line.
    """
    lines = _lines(file)
    if lines[0] != "ply":
        raise PlyError("not a .ply file")
    if lines[1:2] != ["format binary_little_endian 1.0"]:
        raise PlyError("not a binary little-endian .ply file")
    declared: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[2:]:
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, count] if count.isdecimal() and len(count) <= LONGEST_COUNT:
                declared.append((name, int(count), []))
            case ["property", kind, name] if kind in TYPES and declared:
                declared[-1][2].append((name, TYPES[kind]))
            case _:
                raise PlyError(f"header line not understood: {line[:60]!r}")
    return [Element(name, count, _dtype(name, fields)) for name, count, fields in declared], file.tell()


def _lines(file: BinaryIO) -> list[str]:
    """The lines before `end_header`; the file then stands at the first byte of data."""
    lines: list[str] = []
    while (raw := file.readline(LONGEST_HEADER)) and file.tell() <= LONGEST_HEADER:
        line = raw.decode("ascii", "replace").strip()
        if line == "end_header":
            return lines or [""]
        lines.append(line)
        if lines[0] != "ply":
            return lines
    raise PlyError("no end of the header found" if lines else "not a .ply file")


def _dtype(element: str, fields: list[tuple[str, str]]) -> np.dtype:
    if len({name for name, _ in fields}) < len(fields):
        raise PlyError(f"element {element[:60]!r} names a property twice")
    return np.dtype(fields)
