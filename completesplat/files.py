"""Files and folders that are written whole or not at all, JSON among them, and the errors of disks that refuse it."""

import errno
import json
import math
import os
import re
import shutil
import stat
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from completesplat.errors import CompleteSplatError, DiskError
from completesplat.wording import printable

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
UNUSABLE = {errno.EIO, errno.EROFS, errno.EACCES, errno.ESTALE, errno.ENODEV}
BAD_NAME = {errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM}
PROBE_BYTES = 2**16
UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}(\.\w+)?")  # names of temporary files


@contextmanager
def atomic_path(path: str | Path, name: str | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block ends without an exception.

    The folder must exist: one that was removed during a run must not come back with this file alone.
    After an exception the old file is unchanged and the temporary one removed. A link at `path` is not followed.

    Args:
        name: name of the temporary file; by default a unique one with the suffix of `path`.

    Raises:
        DiskError: the file cannot be written. A test write finds the reason if the writing library hides it.
    """
    path = Path(path)
    temporary = path.with_name(name or f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        with writing(path, temporary):
            temporary.unlink(missing_ok=True)
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with suppress(OSError):  # of a disk that failed in the block
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder that becomes the missing `folder` when the block ends without an exception.

    The unfinished folder is removed after an exception, and so is one that a killed process left behind.

    Raises:
        DiskError: as `atomic_path`.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with writing(folder, unfinished):
            unfinished.mkdir()
            yield unfinished
            unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def writing(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Raise DiskError if the operating system refuses to let the block write `path`.

    `temporary` is the file or folder that will become `path`. If an exception gives no reason, a test write to
    `temporary` finds it.
    """
    try:
        yield
    except CompleteSplatError:
        raise
    except Exception as error:
        cause = error if isinstance(error, OSError) and error.errno is not None else _test_write_error(temporary)
        refusal = None if cause is None else _disk_error(cause, path)
        if refusal is None:
            raise
        raise refusal from error


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all, with the errors of `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON file whole or not at all, with the errors of `atomic_path`.

    JSON has no NaN and no infinities: they become null, and the entry `not_finite` lists their values.
    """
    not_finite: list[str] = []
    finite = {key: _finite(value, key, not_finite) for key, value in content.items()}
    if not_finite:
        finite["not_finite"] = not_finite
    write_text(path, json.dumps(finite, indent=2, allow_nan=False) + "\n")


def _finite(value: object, place: str, not_finite: list[str]) -> object:
    if isinstance(value, Mapping):
        return {key: _finite(part, f"{place}.{key}", not_finite) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part, f"{place}.{index}", not_finite) for index, part in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        not_finite.append(f"{place}: {value}")
        return None
    return value


def home_path(name: Path | str) -> Path:
    """Return a path with `~` as the user's home folder, or as it is where the system knows none.

    In a container that is started with a user of its own, there may be neither HOME nor an entry of the user.
    """
    path = Path(name)
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def user_cache() -> Path:
    """Return the folder for this user's caches of this package: in XDG_CACHE_HOME, the home folder or `private_folder`.

    Raises:
        CompleteSplatError: there is none of them.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base) / "completesplat"
    home = home_path("~")
    if home != Path("~"):
        return home / ".cache" / "completesplat"
    folder = private_folder()
    if folder is None:
        raise CompleteSplatError("there is no home folder to keep files in: set XDG_CACHE_HOME=DIR")
    return folder


def private_folder() -> Path | None:
    """Make and return this user's own folder among the temporary files, or None if it may be another user's.

    Programs load code from caches, so nobody else may write there.
    """
    folder = Path(tempfile.gettempdir()) / f"completesplat-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o022
    return folder if private else None


def make_folder(folder: Path) -> None:
    """Make a missing folder in an existing one.

    Raises:
        CompleteSplatError: there is a link at its path.
        DiskError: it cannot be made.
    """
    if folder.is_symlink():
        raise CompleteSplatError(f"{folder}: is a link, and results are not written through links; remove it")
    with writing(folder):
        folder.mkdir(exist_ok=True)


def file_refusal(error: BaseException) -> CompleteSplatError | None:
    """Return the error to show for an OSError about a named file, or None if it is about something else.

    It says that a disk has no space, or that a name cannot be used.
    """
    if not isinstance(error, OSError):
        return None
    name = error.filename2 or error.filename
    if not isinstance(name, str):
        return None
    if error.errno in BAD_NAME:
        reason = f"cannot be used: {error.strerror}; choose another name or out=DIR"
        return CompleteSplatError(f"{printable(name)}: {reason}")
    return _disk_error(error, Path(name)) if error.errno in {*NO_SPACE, errno.EROFS} else None


def _test_write_error(path: Path | None) -> OSError | None:
    """Write more to a file or folder, which is no longer needed, and return the operating system's error, if any."""
    if path is None:
        return None
    try:
        with (path / "more" if path.is_dir() else path).open("ab") as file:
            file.write(bytes(PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    return None


def _disk_error(error: OSError, path: Path) -> DiskError | None:
    """Return the error to show, in the operating system's words, or None if it is not the disk's."""
    if not path.parent.is_dir():
        return DiskError(f"{path}: cannot be written, {path.parent} is not there")
    if error.errno in NO_SPACE | UNUSABLE:
        return DiskError(f"{path}: cannot be written: {error.strerror}")
    return None
