"""The folder of worker processes' temporary files. Those of killed programs are removed by the next one.

Workers that share tensors make folders `pymp-*` with a socket among the temporary files. A worker that is killed, as
Python's end does with those that are still at work, cannot remove its own.
"""

import fcntl
import functools
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.util import Finalize
from pathlib import Path

from completesplat.files import private_folder
from completesplat.signals import leave_to_parent

PREFIX = "w-"  # short, because a socket's path has at most 107 bytes
LONGEST = 107 - len("/w-12345678/pymp-12345678/listener-12345678")


def prepare_worker(folder: str | None, _: int) -> None:
    """Prepare a worker process: leave signals to its parent, and keep temporary files in `folder`, if there is one."""
    leave_to_parent()
    if folder is not None:
        tempfile.tempdir = folder


@functools.cache
def worker_folder() -> str | None:
    """Make and return the folder for temporary files of this program's workers, and remove those of killed programs.

    The program removes it when it ends. Until then a lock tells other programs that it is in use. Workers that are
    forked hold the lock, too, so that it lasts until they have ended.

    Returns:
        None if there is no private folder, if it cannot be locked, or if its name is too long for sockets.
    """
    base = private_folder()
    if base is None or len(os.fsencode(base)) > LONGEST:
        return None
    try:
        with _locked(base):  # so that no other program takes the new folder for one without an owner
            for folder in base.glob(f"{PREFIX}*"):
                _remove_unused(folder)
            made = tempfile.mkdtemp(prefix=PREFIX, dir=base)
            fcntl.flock(os.open(made, os.O_RDONLY), fcntl.LOCK_EX)
    except OSError:
        return None
    # After the workers' end, which has priority 0.
    Finalize(None, shutil.rmtree, (made, True), exitpriority=-1)
    return made


@contextmanager
def _locked(folder: Path, flags: int = 0) -> Iterator[None]:
    """Hold a folder's lock. With `fcntl.LOCK_NB`, raise BlockingIOError if another process holds it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | flags)
        yield
    finally:
        os.close(descriptor)


def _remove_unused(folder: Path) -> None:
    try:
        with _locked(folder, fcntl.LOCK_NB):
            shutil.rmtree(folder, ignore_errors=True)
    except BlockingIOError:  # in use
        return
