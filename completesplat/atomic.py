"""Files and folders that appear whole or not at all, and what is said where the disk is full or a folder is gone."""

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from completesplat.errors import CompleteSplatError, DiskError
from completesplat.names import printable

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
UNUSABLE = {errno.EIO, errno.EROFS, errno.EACCES, errno.ESTALE, errno.ENODEV}
BAD_NAME = {errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM}
PROBE_BYTES = 2**16
BLOCK_BYTES = 512  # of `st_blocks`


@contextmanager
def atomic_path(path: str | Path, name: str | None = None, size: int = 0) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an exception.

    The folder is not made: one that was removed while a program runs does not come back without what was in it. After
    an exception the old file is as it was and nothing is left beside it. A link at `path` is replaced, not followed.

    Args:
        name: of the temporary file; by default one of its own each time, with the suffix of `path`.
        size: bytes that the file needs at least, where that is known beforehand.

    `DiskError`: it cannot be written. Whatever the library says that wrote it, the disk itself is asked.
    """
    path = Path(path)
    temporary = path.with_name(name or f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        with _asking_the_disk(path, temporary, size):
            temporary.unlink(missing_ok=True)
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """An empty folder beside `folder`, which is not there, that becomes it when the block ends without an exception.

    After one nothing is left; nor is what a process left that was killed. `DiskError`: as `atomic_path`.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with _asking_the_disk(folder, unfinished):
            unfinished.mkdir()
            yield unfinished
            unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


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
    """Make a folder, if it is missing, in one that is there.

    Raises:
        CompleteSplatError: the folder is a link, through which results would be written elsewhere.
        DiskError: the folder above is gone, or the disk is full.
    """
    if folder.is_symlink():
        raise CompleteSplatError(f"{folder}: is a link, and results are not written through links; remove it")
    with writing(folder):
        folder.mkdir(exist_ok=True)


def file_refusal(error: BaseException) -> CompleteSplatError | None:
    """Return one line for an error of the operating system with a named file: no space, or a name that cannot be used.

    None for any other error.
    """
    name = (error.filename2 or error.filename) if isinstance(error, OSError) else None
    if not isinstance(error, OSError) or not isinstance(name, str):
        return None
    if error.errno in BAD_NAME:
        return CompleteSplatError(f"{printable(name)}: cannot be used: {error.strerror}; choose another name")
    return _disk_error(error, Path(name)) if error.errno in {*NO_SPACE, errno.EROFS} else None


@contextmanager
def _asking_the_disk(path: Path, temporary: Path, size: int = 0) -> Iterator[None]:
    """`DiskError` where `temporary`, a file or folder that is to become `path`, cannot be written."""
    try:
        yield
    except CompleteSplatError:
        raise
    except Exception as error:
        cause = error if isinstance(error, OSError) and error.errno is not None else _asked(temporary)
        if cause is None or (refusal := _disk_error(cause, path, size, temporary)) is None:
            raise
        raise refusal from error


def _asked(path: Path) -> OSError | None:
    """What the operating system says if more is written to a file or folder, which is no longer needed."""
    try:
        with (path / "more" if path.is_dir() else path).open("ab") as file:
            file.write(bytes(PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    return None


def _disk_error(error: OSError, path: Path, size: int = 0, temporary: Path | None = None) -> DiskError | None:
    """The refusal to show; None for an error that is not of the disk. What `temporary` takes is going to be free."""
    from rich.filesize import decimal

    if not path.parent.is_dir():
        return DiskError(f"{path}: cannot be written, {path.parent} is not there any more")
    if error.errno in NO_SPACE:
        files = [] if temporary is None else [temporary, *temporary.rglob("*")]
        taken = [file.stat() for file in files if file.is_file()]
        size = max(size, sum(file.st_size for file in taken))
        needed = f"{decimal(size)} or more are needed" if size else "more is needed"
        free = shutil.disk_usage(path.parent).free + sum(file.st_blocks for file in taken) * BLOCK_BYTES
        return DiskError(f"{path}: {error.strerror}: {needed}, {decimal(free)} are free on this disk")
    return DiskError(f"{path}: cannot be written: {error.strerror}") if error.errno in UNUSABLE else None
