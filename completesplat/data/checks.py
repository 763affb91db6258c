"""Refusals of bad input, each a `DataError` of one line that names the path."""

import json
import os
import zlib
from gzip import GzipFile
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any, NoReturn, TypeVar

import numpy as np

from completesplat.errors import DataError

MOST_BYTES = 2**32
# Beyond this size a gzipped file may be no more than so many times smaller than its content. Deflate gets up to 1032,
# annotations stay far below.
BYTES_OF_ANY_RATIO, LARGEST_RATIO = 2**26, 200
CHUNK = 2**20
ROTATION_TOLERANCE = 1e-3

T = TypeVar("T")


def require_file(path: Path) -> Path:
    """The path itself.

    Raises:
        DataError: no such file.
    """
    if not path.is_file():
        raise DataError(f"no such file: {path}")
    return path


def inside(root: Path, relative: str) -> Path:
    """The path below `root` that an annotation names. Links are followed as long as they stay below `root`.

    Raises:
        DataError: no plain relative path (absolute, with `..`, a backslash, a drive, a scheme or a NUL), or one that
            leads out of `root` through a link.
    """
    path, windows = PurePath(relative), PureWindowsPath(relative)
    plain = path.parts and not path.is_absolute() and ".." not in path.parts and not windows.drive
    if not plain or any(text in relative for text in ("\0", "\\", "://")):
        raise DataError(f"annotation leads outside of {root}, or nowhere: {relative!r}")
    try:
        # It also takes a path that does not exist, and one whose links form a ring.
        real_root, real_path = os.path.realpath(root), os.path.realpath(root / path)
    except ValueError:
        raise DataError(f"annotation names a path with characters that no file name has: {relative!r}") from None
    if os.path.commonpath([real_root, real_path]) != real_root:
        raise DataError(f"a link leads outside of {root}: {relative!r} is {real_path}")
    return root / path


def read_json(path: Path, allow_nan: bool = False, most_bytes: int = MOST_BYTES) -> Any:
    """The content of a JSON file, gzipped if its name ends in `.jgz`.

    Args:
        allow_nan: take NaN and Infinity, which are no JSON but written by Python, as numbers.
        most_bytes: of the JSON text.

    Raises:
        DataError: a file that is missing, is no (gzipped) JSON in UTF-8, or is too large, unpacked or not.
    """
    try:
        raw = _unpack(path, most_bytes) if path.suffix == ".jgz" else _read(path, most_bytes)
        return json.loads(raw.decode("utf-8"), parse_constant=float if allow_nan else _refuse_constant)
    except (OSError, EOFError, ValueError, zlib.error, RecursionError, MemoryError) as error:
        raise DataError(f"not a JSON file: {path} ({str(error) or type(error).__name__})") from None


def field(entry: object, key: str, kind: type[T]) -> T:
    """A value of a JSON object.

    Raises:
        DataError: no object, without this key, or with a value of another type than `kind` (true is no `int`).
    """
    if type(entry) is not dict or key not in entry:
        raise DataError(f"no {key} in {_shortened(entry)}")
    value = entry[key]
    # `isinstance` would take true for an integer.
    if type(value) is not kind:
        raise DataError(f"{key} must be of type {kind.__name__}, not {_shortened(value)}")
    return value


def finite_array(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Numbers from JSON as a float64 array.

    Raises:
        DataError: not numbers, another shape, or NaN or infinity among them.
    """
    try:
        array = np.array(value)
    except ValueError:  # Lists of unequal length.
        array = np.array(None)
    # Strings that look like numbers, truth values and None become arrays of other kinds.
    if array.shape != shape or array.dtype.kind not in "iuf":
        sides = " x ".join(map(str, shape)) or "one"
        raise DataError(f"{what} must be {sides} numbers, not {_shortened(value)}")
    if not np.isfinite(array).all():
        raise DataError(f"{what} is not finite: {_shortened(value)}")
    return array.astype(np.float64)


def require_rotation(matrix: np.ndarray, what: str) -> None:
    """Refuse a 3 x 3 matrix that is no rotation, within 1e-3 for each entry of R R^T.

    Raises:
        DataError: it is not orthonormal, or a reflection.
    """
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise DataError(f"{what} is not orthonormal")
    if np.linalg.det(matrix) < 0:
        raise DataError(f"{what} is a reflection, not a rotation")


def _shortened(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _read(path: Path, most_bytes: int) -> bytes:
    with require_file(path).open("rb") as file:
        raw = file.read(most_bytes + 1)
    if len(raw) > most_bytes:
        raise DataError(f"{path} has more than {most_bytes:,} bytes")
    return raw


def _unpack(path: Path, most_bytes: int) -> bytearray:
    raw, packed = bytearray(), require_file(path).stat().st_size
    limit = min(most_bytes, max(BYTES_OF_ANY_RATIO, LARGEST_RATIO * packed))
    with GzipFile(path) as file:
        while chunk := file.read(CHUNK):
            raw += chunk
            if len(raw) > limit:
                raise DataError(f"{path} unpacks to more than {limit:,} bytes from {packed:,}")
    return raw


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")
