"""Locks of jobs' folders, in which only one job works at a time, and which process of a job this one is."""

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from completesplat.errors import CompleteSplatError
from completesplat.files import UNFINISHED, writing

LOCK = ".lock"


def one_of_several() -> bool:
    """Return whether torchrun (`LOCAL_RANK`) or srun (`SLURM_STEP_NUM_TASKS`) started several of this process."""
    return "LOCAL_RANK" in os.environ or int(os.environ.get("SLURM_STEP_NUM_TASKS", 1)) > 1


def is_first_process() -> bool:
    """Return whether this process is alone, or the first that torchrun (`RANK`) or srun (`SLURM_PROCID`) started."""
    return int(os.environ.get("RANK", os.environ.get("SLURM_PROCID", 0))) == 0


@contextmanager
def hold_job_lock(folder: Path, out: Path) -> Iterator[None]:
    """Hold the lock of a job's folder in the job's first process; the lock file names process and computer.

    The operating system releases the lock when the process ends, for whatever reason. The unfinished files of a killed
    process are removed, except below the folders of other jobs.

    Raises:
        CompleteSplatError: another process holds the lock, or its path is a link or a folder; or a job that is no shard
            and one that is would write into `out` at the same time.
    """
    path = folder / LOCK
    if not is_first_process():
        yield
        return
    if path.is_symlink() or path.is_dir():
        raise CompleteSplatError(f"{path}: is a link or a folder, and the lock is a file; remove it")
    try:
        with writing(path):
            lock = FileLock(path).acquire(blocking=False)
    except Timeout:
        raise _busy(folder) from None
    with lock:
        others = list(out.glob("shard-*")) if folder == out else [out]
        for other in others:
            if is_running(other):
                raise _busy(other)
        with writing(path):
            path.write_text(f"{os.getpid()}\n{platform.node()}\n")
        _remove_unfinished(folder)
        yield


def _remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files in a folder, except below the folders of other jobs."""
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not Path(place, name, LOCK).exists()]
        for name in names:
            if UNFINISHED.fullmatch(name):
                Path(place, name).unlink(missing_ok=True)


def _busy(folder: Path) -> CompleteSplatError:
    holder = (folder / LOCK).read_text().split()
    named = f"process {holder[0]} on {holder[1]}" if len(holder) > 1 else "another process"
    return CompleteSplatError(f"{folder}: {named} is at work in it: wait for it or end it, or choose another out=DIR")


def is_running(out: Path) -> bool:
    """Return whether a process of this computer holds the lock of a job's directory."""
    path = out / LOCK
    if not path.is_file():
        return False
    try:
        with FileLock(path).acquire(timeout=0.2):  # for which another process may look, too
            return False
    except PermissionError:  # another user's run, which a lock cannot tell about
        return False
    except (Timeout, OSError):
        return True
