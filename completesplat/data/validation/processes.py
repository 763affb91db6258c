"""Parallel map over processes, whose results and order do not depend on the number of processes."""

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar, cast

from completesplat.errors import CompleteSplatError
from completesplat.signals import Interrupted, end_with_parent

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_cores() -> int:
    """Return the number of cores that this process may use, which a cluster or container may limit."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on Macs and Windows
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def share_of(items: Sequence[Item], shard: int, shards: int) -> Sequence[Item]:
    """Return every `shards`-th item from number `shard` on. Raise CompleteSplatError if there is no such shard."""
    if not 0 <= shard < shards:
        raise CompleteSplatError(f"shard={shard}: must lie between 0 and {shards - 1}, for shards={shards}")
    return items[shard::shards]


def map_in_processes(work: Callable[[Item], Result], items: Sequence[Item], workers: int | None) -> Iterator[Result]:
    """Yield `work` of every item in order, by `workers` processes (None: one for each usable core) that get it once.

    Raises:
        CompleteSplatError: a process ended unexpectedly.
        Interrupted: the run was interrupted; the processes end with the same exception.
    """
    processes = min(workers or usable_cores(), len(items))
    if processes <= 1:
        yield from map(work, items)
        return
    # Pickled to bytes, because torch would share each tensor as an open file, and there are too many cameras for that.
    contents = pickle.dumps(work)
    with ProcessPoolExecutor(processes, get_context("spawn"), _start, (contents,)) as pool:
        try:
            yield from cast(Iterator[Result], pool.map(_call, items))
        except BrokenProcessPool:
            advice = "run the same command again, with fewer workers"
            raise CompleteSplatError(f"a worker process ended unexpectedly (out of memory?): {advice}") from None
        except (Interrupted, GeneratorExit):
            for process in pool._processes.values():
                process.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_function: Callable[[object], object]


def _start(contents: bytes) -> None:
    """Prepare a new process and store its work."""
    import torch

    global _function
    end_with_parent()
    torch.set_num_threads(1)  # There is one process for each core.
    with _ends_when_interrupted():
        _function = pickle.loads(contents)  # written by the parent process


def _call(item: object) -> object:
    with _ends_when_interrupted():
        return _function(item)


@contextmanager
def _ends_when_interrupted() -> Iterator[None]:
    """End this process at once when it is interrupted, because the pool would print the exception or wait for it."""
    try:
        yield
    except Interrupted as stop:
        os._exit(128 + stop.signal)
