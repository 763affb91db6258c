"""Files that appear whole or not at all, and what is said where the disk is full or a folder is gone."""

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from completesplat.errors import CompleteSplatError, DiskError

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
UNUSABLE = {errno.EIO, errno.EROFS, errno.EACCES, errno.ESTALE, errno.ENODEV}
PROBE_BYTES = 2**16
BLOCK_BYTES = 512  # of `st_blocks`


@contextmanager
def atomic_path(path: str | Path, name: str | None = None, size: int = 0) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an exception.

    The folder is not made: one that was removed while a program runs does not come back without what was in it. After
    an exception the old file is as it was and nothing is left beside it.

    Args:
        name: of the temporary file; by default one of its own each time, with the suffix of `path`.
        size: bytes that the file needs at least, where that is known beforehand.

    `DiskError`: it cannot be written. Whatever the library says that wrote it, the disk itself is asked.
    """
    path = Path(path)
    temporary = path.with_name(name or f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except CompleteSplatError:
        raise
    except Exception as error:
        size = max(size, temporary.stat().st_size if temporary.is_file() else 0)
        cause = error if isinstance(error, OSError) and error.errno is not None else _refusal_of_disk(temporary)
        if cause is None or (refusal := _disk_error(cause, path, size, temporary)) is None:
            raise
        raise refusal from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path, size: int = 0) -> Iterator[None]:
    """`DiskError` where the operating system refuses what the block writes to `path`: `size` bytes at least."""
    try:
        yield
    except OSError as error:
        if (refusal := _disk_error(error, path, size)) is None:
            raise
        raise refusal from error


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all; `DiskError` as `atomic_path`."""
    with atomic_path(path, size=len(content)) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | Path, text: str) -> None:
    """Write a file of text, in UTF-8, as `write_bytes` does."""
    write_bytes(path, text.encode())


def make_folder(folder: Path) -> None:
    """Make a folder, if it is missing, in one that is there; `DiskError` if that is gone or the disk is full."""
    with writing(folder):
        folder.mkdir(exist_ok=True)


def _refusal_of_disk(path: Path) -> OSError | None:
    """What the operating system says if more is written to a file, which is no longer needed."""
    try:
        with path.open("ab") as file:
            file.write(bytes(PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    return None


def _disk_error(error: OSError, path: Path, size: int, temporary: Path | None = None) -> DiskError | None:
    """The refusal to show; None for an error that is not of the disk. What `temporary` takes is going to be free."""
    from rich.filesize import decimal

    if not path.parent.is_dir():
        return DiskError(f"{path}: cannot be written, {path.parent} is not there any more")
    if error.errno in NO_SPACE:
        needed = f"{decimal(size)} or more are needed" if size else "more is needed"
        free = shutil.disk_usage(path.parent).free
        if temporary is not None and temporary.is_file():
            free += temporary.stat().st_blocks * BLOCK_BYTES
        return DiskError(f"{path}: {error.strerror}: {needed}, {decimal(free)} are free on this disk")
    return DiskError(f"{path}: cannot be written: {error.strerror}") if error.errno in UNUSABLE else None
