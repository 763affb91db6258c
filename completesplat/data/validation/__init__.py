"""Checks of the files, names and numbers of a data set, which raise the subclasses of `DataError`."""

import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import partial
from gzip import GzipFile
from pathlib import Path, PurePath, PureWindowsPath
from types import UnionType
from typing import Any, NoReturn, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float

from completesplat.errors import BadAnnotation, BadCamera, MissingFile, OutsidePath, PlyError, UnreadableFile
from completesplat.ply_files import read_vertices
from completesplat.wording import SHORT, printable

MOST_BYTES = 2**32
# Content above the first size may be larger than its gzipped file by at most the second factor. Deflate reaches 1032;
# annotations of frames have 6, those of sequences 23.
BYTES_OF_ANY_RATIO = 2**24
LARGEST_RATIO = 40
CHUNK = 2**20  # bytes that are read at once
ROTATION_TOLERANCE = 1e-3
LARGEST = 2.0**60  # numbers whose squares float32 holds, too

T = TypeVar("T")


def require_file(path: Path) -> Path:
    """Return the path itself if the file exists, or refuse it as missing."""
    # `Path.is_file` raises if a name is too long or a folder may not be entered.
    if not os.path.isfile(path):
        raise MissingFile("no such file", str(path))
    return path


def path_below(root: Path, relative: str) -> Path:
    """Return the path below `root` that an annotation names.

    Links are followed if they stay below `root`, or lead to the store of the program that made them (`_stores`).

    Backslashes are separators, as on Windows. An absolute path may lead into `root`.

    Raises:
        OutsidePath: the path is empty, has `..`, a drive, scheme or NUL, or it or a link leads out.
    """
    path = PurePath(relative.replace("\\", "/"))
    windows = PureWindowsPath(relative)
    absolute = path.is_absolute() or bool(windows.drive)
    preview = printable(repr(relative), SHORT)
    if not path.parts or ".." in path.parts or any(text in relative for text in ("\0", "://")):
        raise OutsidePath(f"leads outside of {root}, or nowhere: {preview}")
    try:
        # `realpath` also accepts a path that does not exist, and one whose links form a ring.
        real_root = os.path.realpath(root)
        real_path = os.path.realpath(root / path)
    except ValueError:
        raise OutsidePath(f"characters that no file name has: {preview}") from None
    inside = any(os.path.commonpath([place, real_path]) == place for place in (real_root, *_stores(real_root)))
    if windows.drive or not inside:
        if absolute and not os.path.lexists(path):
            raise OutsidePath(f"a path of another machine; make it relative to {root}: {preview}")
        advice = "" if absolute else "; links may not leave it, so name the real folder"
        raise OutsidePath(f"leads outside of {root}: {preview} is {real_path}{advice}")
    return root / (os.path.relpath(real_path, real_root) if absolute else path)


def _stores(real_root: str) -> list[str]:
    """Return the folders that hold the content of links in a folder of the Hugging Face hub, DVC or git-annex.

    The hub's snapshot `REPOSITORY/snapshots/REVISION` has links to `REPOSITORY/blobs`. In a repository, DVC's links
    lead to `.dvc/cache`, and git-annex's to `.git/annex/objects`.
    """
    places = []
    for folder in (Path(real_root), *Path(real_root).parents):
        if folder.parent.name == "snapshots":
            places.append(folder.parent.parent / "blobs")
        places += [folder / ".dvc" / "cache", folder / ".git" / "annex" / "objects"]
    return [str(place) for place in places if place.is_dir()]


def read_json(path: Path, allow_nan: bool = False) -> Any:
    """Read a JSON file, which is gzipped if its name ends in `.jgz`.

    Args:
        allow_nan: accept NaN and Infinity as numbers; they are no JSON, but Python writes them.

    Raises:
        MissingFile: the file does not exist.
        UnreadableFile: it is no (gzipped) JSON in UTF-8, or too large, unpacked or not.
    """
    with _refused_as_unreadable(path, "JSON file"):
        text = _read(path, MOST_BYTES).decode("utf-8-sig")
        return json.loads(text, parse_constant=float if allow_nan else _refuse_constant)


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """Read a text file in UTF-8, with the errors of `read_json`."""
    with _refused_as_unreadable(path, "text file"):
        return _read(path, most_bytes).decode("utf-8-sig")


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the positions of a PLY file's vertices in float64, with the errors of `read_json`."""
    with _refused_as_unreadable(require_file(path), "point cloud"):
        vertices = read_vertices(path, "xyz")
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def field(entry: object, key: str, kind: type[T]) -> T:
    """Return a value of a JSON object as `parsed` converts it, or refuse one that is missing."""
    return parsed(kind, _entry(entry, key), key)


def _entry(entry: object, key: str) -> object:
    if type(entry) is not dict or key not in entry:
        raise BadAnnotation(f"no {key} in {printable(repr(entry), SHORT)}")
    return entry[key]


def parsed(kind: Any, value: Any, name: str = "the content") -> Any:
    """Convert a JSON value to `kind`, a dataclass, tuple, dictionary, union or plain type.

    Raises:
        BadAnnotation: the value has another type (true is no `int`), or a field is missing.
    """
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is tuple and type(value) is list:
        return tuple(parsed(arguments[0], item, name) for item in value)
    if origin is dict and type(value) is dict:
        return {key: parsed(arguments[1], item, key) for key, item in value.items()}
    if isinstance(kind, type) and is_dataclass(kind) and type(value) is dict:
        fields = {key: parsed(hint, _entry(value, key), key) for key, hint in get_type_hints(kind).items()}
        return kind(**fields)
    if kind is float and type(value) is int:  # some programs write 0 for 0.0
        return value
    allowed = arguments if origin is UnionType else (kind,)
    if type(value) in allowed:
        return value
    preview = printable(repr(value), SHORT)
    raise BadAnnotation(f"{name} must be of type {getattr(kind, '__name__', kind)}, not {preview}")


def finite_array(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert numbers from JSON to float64.

    Raises:
        BadAnnotation: the value has another type or shape, or is not finite in float32.
    """
    try:
        array = np.array(value)
    except ValueError:  # Lists of unequal length.
        array = np.array(None)
    # Strings that look like numbers, truth values and None become arrays of other kinds.
    if array.shape != shape or array.dtype.kind not in "iuf":
        count = " x ".join(map(str, shape))
        numbers = f"{count} numbers" if shape else "a number"
        raise BadAnnotation(f"{what} must be {numbers}, not {printable(repr(value), SHORT)}")
    array = array.astype(np.float64)
    if not (np.abs(array) < LARGEST).all():
        raise BadAnnotation(f"{what} is not finite in float32: {printable(repr(value), SHORT)}")
    return array


def require_rotation(matrix: np.ndarray, what: str, tolerance: float = ROTATION_TOLERANCE) -> float:
    """Refuse a 3 x 3 matrix that is no rotation, and return the largest entry of R R^T - I, which is tolerated."""
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error > tolerance:
        raise BadCamera(f"{what} is not orthonormal (R R^T - I up to {error:.2g}, at most {tolerance:g})")
    if np.linalg.det(matrix) < 0:
        raise BadCamera(f"{what} is a reflection, not a rotation")
    return error


@contextmanager
def _refused_as_unreadable(path: Path, kind: str) -> Iterator[None]:
    """Turn the errors by which Python's readers and ours notice a damaged file into an UnreadableFile."""
    try:
        yield
    except (OSError, EOFError, ValueError, zlib.error, RecursionError, MemoryError, PlyError) as error:
        raise UnreadableFile(f"not a {kind} ({str(error) or type(error).__name__})", str(path)) from None


def _read(path: Path, most_bytes: int) -> bytearray:
    """Read the bytes of a file, unpacked if its name ends in `.jgz`."""
    raw = bytearray()
    size = require_file(path).stat().st_size
    packed = path.suffix == ".jgz"
    limit = most_bytes
    if packed:
        limit = min(most_bytes, max(BYTES_OF_ANY_RATIO, LARGEST_RATIO * size))
    with GzipFile(path) if packed else path.open("rb") as file:
        for chunk in iter(partial(file.read, CHUNK), b""):
            raw += chunk
            if len(raw) > limit:
                raise UnreadableFile(f"{size:,} bytes hold more than {limit:,} bytes", str(path))
    return raw


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")
