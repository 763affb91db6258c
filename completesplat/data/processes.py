"""Work for several processes: the same results in the same order, however many they are."""

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, TypeVar

import torch

from completesplat.errors import CompleteSplatError
from completesplat.signals import Interrupted, end_with_parent

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int | None
) -> Iterator[Result]:
    """`function` of every item, in order, by `workers` processes (None: one a core), each of which gets it once.

    Raises:
        CompleteSplatError: a process ended unexpectedly.
        Interrupted: the processes end, too; what `function` was doing ends with the same exception.
    """
    workers = min(workers or os.cpu_count() or 1, len(items))
    if workers <= 1:
        yield from map(function, items)
        return
    # As bytes: torch would share each tensor as an open file, and a data set has more cameras than those may be.
    contents = pickle.dumps(function)
    with ProcessPoolExecutor(workers, get_context("spawn"), _start, (contents,)) as pool:
        try:
            yield from pool.map(_call, items)
        except BrokenProcessPool:
            advice = "run the same command again, with fewer workers"
            raise CompleteSplatError(f"a worker process ended unexpectedly (out of memory?): {advice}") from None
        except (Interrupted, GeneratorExit):
            for process in pool._processes.values():
                process.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_function: Callable[[Any], Any]


def _start(contents: bytes) -> None:
    """Remember in a new process what it is for."""
    global _function
    end_with_parent()
    torch.set_num_threads(1)  # There is one process for each core.
    _function = pickle.loads(contents)  # by this process's parent


def _call(item: Any) -> Any:
    try:
        return _function(item)
    except Interrupted as stop:
        os._exit(128 + stop.signal)  # the pool would send it to the parent as a result, and wait for the next item
