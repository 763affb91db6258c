"""Refusals of bad input, each a `DataError` of one line that names the path."""

import gzip
import json
from pathlib import Path, PurePath
from typing import Any

from completesplat.errors import DataError


def require_file(path: Path) -> Path:
    """The path itself.

    Raises:
        DataError: no such file.
    """
    if not path.is_file():
        raise DataError(f"no such file: {path}")
    return path


def inside(root: Path, relative: str) -> Path:
    """The path below `root` that an annotation names. Links within `root` are its owner's business and are followed.

    Raises:
        DataError: an absolute path, or one with `..` in it.
    """
    path = PurePath(relative)
    if path.is_absolute() or ".." in path.parts or "\0" in relative:
        raise DataError(f"annotation leads outside of {root}: {relative!r}")
    return root / path


def read_json(path: Path) -> Any:
    """The content of a JSON file, gzipped if its name ends in `.jgz`.

    Raises:
        DataError: a file that is missing or is no (gzipped) JSON.
    """
    raw = require_file(path).read_bytes()
    try:
        return json.loads(gzip.decompress(raw) if path.suffix == ".jgz" else raw)
    except (OSError, EOFError, ValueError) as error:
        raise DataError(f"not a JSON file: {path} ({error})") from None
