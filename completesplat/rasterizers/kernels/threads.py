"""Python threads for kernels that release the GIL, as many as `torch.get_num_threads()`.

No OpenMP here: a forked child (a data-loader worker, say) can render too.
"""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()


def parallel(task: Callable[[int], None], count: int) -> None:
    """Run task(0), ..., task(count - 1), each on whichever thread is free, and wait for all of them."""
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
    with _lock:
        if size not in _pools:
            _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="rasterizer")
        return _pools[size]


def _forget_pools() -> None:
    """Threads do not survive a fork: the child would wait forever for those of its parent."""
    global _lock
    _pools.clear()
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)
