"""Vertices of PLY files: the header, and one array with a field for each property.

Format: Greg Turk, "The PLY Polygon File Format" (1994). Both the old and the new names of types are read.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from completesplat.errors import PlyError

PACKED = "packed_position"  # a property of the vertices in compressed files
LONGEST_HEADER = 1 << 16  # bytes
LONGEST_COUNT = 15  # digits
HEADER = re.compile(rb"ply\s*\n(.*?)(?<=\n)end_header[ \t\r]*\n", re.DOTALL)
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


class Element(NamedTuple):
    """An element that a header declares, with its properties and their types.

    The type of a list is that of its length.
    """

    name: str
    records: int
    fields: dict[str, str]
    lists: bool

    def dtype(self, order: str) -> np.dtype[np.void]:
        """Return the dtype of a record, or, if it has lists, of the shortest possible record."""
        return np.dtype([(name, order + kind) for name, kind in self.fields.items()])


def vertex_header(count: int, properties: Sequence[tuple[str, str]], comments: Sequence[str] = ()) -> bytes:
    """Return the header of a binary little-endian file that has vertices only.

    Args:
        properties: names and types (`TYPES`), in the order of a record.
        comments: one line each. Characters outside ASCII are escaped.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    # A line break inside a comment would start another header line.
    lines += [f"comment {' '.join(comment.split())}" for comment in comments]
    lines.append(f"element vertex {count}")
    lines += [f"property {kind} {name}" for name, kind in properties]
    lines += ["end_header", ""]
    return "\n".join(lines).encode("ascii", "backslashreplace")


def read_vertices(path: str | Path, needed: Sequence[str]) -> np.ndarray:
    """Read the vertices of a file, ASCII or binary, as an array [n] with a field for each property.

    Other elements are left out. Lists (of faces) may only follow the vertices.

    Raises:
        PlyError: the file is missing, damaged or of another size than its header declares, or one of the `needed`
            properties is missing. The message does not name the file.
    """
    try:
        if not Path(path).is_file():
            raise PlyError("no such file")
        with Path(path).open("rb") as file:
            return _vertices(file, needed)
    except OSError as error:
        raise PlyError(f"{error.strerror or error}") from error


def _vertices(file: BinaryIO, needed: Sequence[str]) -> np.ndarray:
    start = file.read(LONGEST_HEADER)
    if not start.startswith(b"ply"):
        raise PlyError("not a .ply file")
    header_match = HEADER.match(start)
    if header_match is None:
        raise PlyError("no end of the header found")
    form, *lines = header_match[1].decode("ascii", "replace").splitlines() or [""]
    elements = _elements(lines)
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise PlyError("several elements vertex" if "vertex" in names else "no element vertex")
    index = names.index("vertex")
    if any(element.lists for element in elements[: index + 1]):
        raise PlyError("a list in the vertices, or before them")
    if PACKED in elements[index].fields:
        raise PlyError("SuperSplat's compressed PLY; `splat-transform FILE x.ply` unpacks it")
    missing = [name for name in needed if name not in elements[index].fields]
    if missing:
        raise PlyError(f"no property {', '.join(missing)}")
    file.seek(header_match.end())
    match form.split():
        case ["format", "ascii", "1.0"]:
            return _from_text(file, elements, index)
        case ["format", kind, "1.0"] if kind in BYTE_ORDERS:
            return _from_bytes(file, elements, index, BYTE_ORDERS[kind])
    raise PlyError(f"format not understood: {form[:60]!r}")


def _elements(lines: Sequence[str]) -> list[Element]:
    declared: list[Element] = []
    for line in lines:
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, count] if count.isdecimal() and len(count) <= LONGEST_COUNT:
                declared.append(Element(name, int(count), {}, False))
            case ["property", kind, name] if kind in TYPES and declared:
                declared[-1] = _with_property(declared[-1], name, kind)
            case ["property", "list", kind, item, name] if kind in TYPES and item in TYPES and declared:
                declared[-1] = _with_property(declared[-1], name, kind)._replace(lists=True)
            case _:
                raise PlyError(f"header line not understood: {line[:60]!r}")
    return declared


def _with_property(element: Element, name: str, kind: str) -> Element:
    if name in element.fields:
        raise PlyError(f"element {element.name[:60]!r} names a property twice")
    return element._replace(fields={**element.fields, name: TYPES[kind]})


def _from_bytes(file: BinaryIO, elements: Sequence[Element], index: int, order: str) -> np.ndarray:
    sizes = [element.records * element.dtype(order).itemsize for element in elements]
    start = file.tell()
    actual = file.seek(0, os.SEEK_END)
    least = start + sum(sizes)
    if actual < least or (actual > least and not any(element.lists for element in elements)):
        raise PlyError(f"the header declares {least} bytes, the file has {actual}")
    file.seek(start + sum(sizes[:index]))
    return np.fromfile(file, elements[index].dtype(order), elements[index].records)


def _from_text(file: BinaryIO, elements: Sequence[Element], index: int) -> np.ndarray:
    dtype = elements[index].dtype("=")
    count = elements[index].records
    try:
        lines = [line for line in file.read().decode("ascii").split("\n") if line.strip()]
        declared = sum(element.records for element in elements)
        if len(lines) != declared:
            raise PlyError(f"the header declares {declared} lines of data, the file has {len(lines)}")
        before = sum(element.records for element in elements[:index])
        rows = lines[before : before + count]
        return np.loadtxt(rows, dtype, comments=None, ndmin=1) if rows else np.empty(0, dtype)  # it warns of none
    except ValueError as error:  # raised for characters that are not ASCII, too
        raise PlyError(" ".join(str(error).split())) from None
