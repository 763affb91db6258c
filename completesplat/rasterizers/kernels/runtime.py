"""Threads that share the tasks of a batch, and memory that is reused from one batch to the next."""

import math
import mmap
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

LARGE = 2**20  # bytes. For smaller blocks, advice to the system would cost more than it gains
MOST_FREE_BYTES = 2**31  # after a new block. The system can take what is free, so this is no loss to others

_pools: dict[int, ThreadPoolExecutor] = {}
_pool_lock = threading.Lock()
_free: list[mmap.mmap] = []  # oldest first
_free_lock = threading.Lock()


def parallel(task: Callable[[int], None], count: int) -> None:
    """Run task(0), ..., task(count - 1), each on any free thread, and wait for all of them."""
    helpers = min(torch.get_num_threads(), count) - 1
    if helpers < 1:
        for i in range(count):
            task(i)
        return
    remaining = iter(range(count))
    lock = threading.Lock()

    def work() -> None:
        while True:
            with lock:
                i = next(remaining, None)
            if i is None:
                return
            task(i)

    futures = [_pool(helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


def _pool(size: int) -> ThreadPoolExecutor:
    with _pool_lock:
        if size not in _pools:
            _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="rasterizer")
        return _pools[size]


def _after_a_fork() -> None:
    """Replace pools and locks in a child process, where the threads that may hold the locks do not exist."""
    global _pool_lock, _free_lock
    _pools.clear()
    _pool_lock = threading.Lock()
    _free_lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_a_fork)


class _Loan(np.ndarray):
    """Bytes whose memory is free again once no array that views them is left."""

    base: mmap.mmap  # type: ignore[assignment]

    # Defaults hold the values that are needed, because globals may be gone when the interpreter ends.
    def __del__(self, free: list[mmap.mmap] = _free, large: int = LARGE, advice: int = mmap.MADV_FREE) -> None:
        if len(self.base) >= large:
            # It stays in place, to be written again without page faults, unless the system needs it elsewhere.
            self.base.madvise(advice)
        # No lock: the garbage collector may call this while `_take` of the same thread holds it. And append is atomic.
        free.append(self.base)


def empty(shape: tuple[int, ...], dtype: type[np.number] = np.float32) -> np.ndarray:
    """Return an uninitialised, aligned array in memory that is reused after the array and its views are deleted."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = _take(-(-max(size, 1) // mmap.PAGESIZE) * mmap.PAGESIZE)
    # NumPy keeps views of views from skipping the loan, because the types differ.
    array: np.ndarray = _Loan(len(memory), np.uint8, memory).view(np.ndarray)[:size].view(dtype).reshape(shape)
    return array


def _take(size: int) -> mmap.mmap:
    """Return the smallest free block of one to two times the size, or a new one."""
    with _free_lock:
        fitting = [(len(memory), i) for i, memory in enumerate(_free) if size <= len(memory) <= 2 * size]
        if fitting:
            return _free.pop(min(fitting)[1])
        while sum(map(len, _free)) > MOST_FREE_BYTES:
            del _free[0]
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if size >= LARGE and hasattr(mmap, "MADV_HUGEPAGE"):  # Linux
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


def release() -> None:
    """Return unused memory to the system."""
    with _free_lock:
        _free.clear()
