"""Refusals of bad input: one class of `DataError` for each kind, and the checks that they come from."""

import json
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from gzip import GzipFile
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any, NoReturn, TypeVar

import numpy as np

from completesplat.errors import DataError, PlyError
from completesplat.ply_files import read_vertices

MOST_BYTES = 2**32
# Beyond this size a gzipped file may be smaller than its content by no more than this factor. Deflate gets up to 1032,
# annotations of frames 6, those of sequences 23.
BYTES_OF_ANY_RATIO, LARGEST_RATIO = 2**24, 40
CHUNK = 2**20  # of a file that is read
ROTATION_TOLERANCE = 1e-3

T = TypeVar("T")
Refuse = Callable[[DataError], None]


class MissingFile(DataError, kind="missing file"):
    """A file that an annotation or a layout promises is not there."""


class OutsidePath(DataError, kind="path outside of the data"):
    """A path in an annotation that leads out of the data's folder, or nowhere."""


class UnreadableFile(DataError, kind="unreadable file"):
    """A file other than a picture that is damaged, too large, unsafe to read or of another format."""


class BadAnnotation(DataError, kind="malformed annotation"):
    """An annotation without a key that is needed, or with a value of another type or shape."""


class BadCamera(DataError, kind="impossible camera"):
    """A pose or intrinsics that no camera has."""


class BadPicture(DataError, kind="unusable picture"):
    """A picture, mask or depth map that is damaged, too large, of another size or without a plain meaning."""


class BadPlacement(DataError, kind="object without a place"):
    """Nothing shows where a sequence's object is and how large."""


class TooFewFrames(DataError, kind="too few frames"):
    """A sequence with too few (usable) frames."""


class SharedSequences(DataError, kind="shared sequence"):
    """A list of sequences to train or validate on that names some to test on."""


class ChangedFile(DataError, kind="changed file"):
    """A file that is no longer what its checksum was taken of."""


@contextmanager
def at(file: Path | str | None = None, sequence: str | None = None, frame: int | None = None) -> Iterator[None]:
    """Tell refusals from within where they happened, as far as they do not know it themselves."""
    try:
        yield
    except DataError as error:
        place = error.file or (None if file is None else str(file)), error.sequence or sequence
        raise type(error)(error.reason, *place, frame if error.frame is None else error.frame) from error.__cause__


@contextmanager
def refused_to(refuse: Refuse) -> Iterator[None]:
    """Hand a refusal from within to `refuse`, which may collect it or raise it."""
    try:
        yield
    except DataError as error:
        refuse(error)


def require_file(path: Path) -> Path:
    """The path itself; `MissingFile` if there is no such file."""
    # `Path.is_file` raises where a name is too long or a folder may not be entered.
    if not os.path.isfile(path):
        raise MissingFile("no such file", str(path))
    return path


def inside(root: Path, relative: str) -> Path:
    """The path below `root` that an annotation names. Links are followed as long as they stay below `root`.

    Raises:
        OutsidePath: no plain relative path (absolute, with `..`, a backslash, a drive, a scheme or a NUL), or one that
            leads out of `root` through a link.
    """
    path, windows = PurePath(relative), PureWindowsPath(relative)
    plain = path.parts and not path.is_absolute() and ".." not in path.parts and not windows.drive
    if not plain or any(text in relative for text in ("\0", "\\", "://")):
        raise OutsidePath(f"leads outside of {root}, or nowhere: {_shortened(relative)}")
    try:
        # It also takes a path that does not exist, and one whose links form a ring.
        real_root, real_path = os.path.realpath(root), os.path.realpath(root / path)
    except ValueError:
        raise OutsidePath(f"characters that no file name has: {_shortened(relative)}") from None
    if os.path.commonpath([real_root, real_path]) != real_root:
        raise OutsidePath(f"a link leads outside of {root}: {_shortened(relative)} is {real_path}")
    return root / path


def read_json(path: Path, allow_nan: bool = False) -> Any:
    """The content of a JSON file, gzipped if its name ends in `.jgz`.

    Args:
        allow_nan: take NaN and Infinity, which are no JSON but written by Python, as numbers.

    Raises:
        MissingFile: no such file.
        UnreadableFile: no (gzipped) JSON in UTF-8, or too large, unpacked or not.
    """
    try:
        text = _read(path, MOST_BYTES).decode("utf-8")
        return json.loads(text, parse_constant=float if allow_nan else _refuse_constant)
    except (OSError, EOFError, ValueError, zlib.error, RecursionError, MemoryError) as error:
        raise UnreadableFile(f"not a JSON file ({str(error) or type(error).__name__})", str(path)) from None


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """The content of a text file in UTF-8; `MissingFile` if there is none, `UnreadableFile` if no text or too large."""
    try:
        return _read(path, most_bytes).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnreadableFile(f"not a text file ({type(error).__name__})", str(path)) from None


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of a PLY file as `read_vertices`, and their places [n 3] in float64; errors as of `read_text`."""
    require_file(path)
    try:
        vertices = read_vertices(path, "xyz")
    except PlyError as error:
        raise UnreadableFile(f"not a point cloud ({error})", str(path)) from None
    return vertices, np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def field(entry: object, key: str, kind: type[T]) -> T:
    """A value of a JSON object; `BadAnnotation` if it is missing or of another type than `kind` (true is no `int`)."""
    if type(entry) is not dict or key not in entry:
        raise BadAnnotation(f"no {key} in {_shortened(entry)}")
    value = entry[key]
    # `isinstance` would take true for an integer.
    if type(value) is not kind:
        raise BadAnnotation(f"{key} must be of type {kind.__name__}, not {_shortened(value)}")
    return value


def finite_array(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Numbers from JSON as a float64 array; `BadAnnotation` for anything else, another shape, NaN or infinity."""
    try:
        array = np.array(value)
    except ValueError:  # Lists of unequal length.
        array = np.array(None)
    # Strings that look like numbers, truth values and None become arrays of other kinds.
    if array.shape != shape or array.dtype.kind not in "iuf":
        numbers = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        raise BadAnnotation(f"{what} must be {numbers}, not {_shortened(value)}")
    if not np.isfinite(array).all():
        raise BadAnnotation(f"{what} is not finite: {_shortened(value)}")
    return array.astype(np.float64)


def require_rotation(matrix: np.ndarray, what: str) -> None:
    """Raise `BadCamera` for a 3 x 3 matrix that is no rotation, within 1e-3 for each entry of R R^T."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise BadCamera(f"{what} is not orthonormal")
    if np.linalg.det(matrix) < 0:
        raise BadCamera(f"{what} is a reflection, not a rotation")


def _shortened(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _read(path: Path, most_bytes: int) -> bytearray:
    """The bytes of a file, unpacked if its name ends in `.jgz`."""
    raw, size, packed = bytearray(), require_file(path).stat().st_size, path.suffix == ".jgz"
    limit = min(most_bytes, max(BYTES_OF_ANY_RATIO, LARGEST_RATIO * size)) if packed else most_bytes
    with GzipFile(path) if packed else path.open("rb") as file:
        while chunk := file.read(CHUNK):
            raw += chunk
            if len(raw) > limit:
                raise UnreadableFile(f"{size:,} bytes hold more than {limit:,} bytes", str(path))
    return raw


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")
