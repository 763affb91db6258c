"""Memory that is used again in the next step: fresh pages from the system would cost as much as the kernels."""

import math
import os
import threading
from typing import Any

import numpy as np

ALIGNMENT = 64  # bytes, one cache line
MOST_FREE_BYTES = 512 * 2**20

_free: list[np.ndarray] = []  # of uint8, oldest first
_lock = threading.Lock()


class Buffers:
    """Arrays that are handed back for reuse when this object is deleted (with the autograd node that owns it)."""

    def __init__(self) -> None:
        self._blocks: list[np.ndarray] = []

    def empty(self, shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """An uninitialised array at an aligned address."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        block = _take(size)
        self._blocks.append(block)
        start = -block.ctypes.data % ALIGNMENT
        return block[start : start + size].view(dtype).reshape(shape)

    def __del__(self) -> None:
        # No lock: the garbage collector may come here while `_take` of the same thread holds it. extend is atomic.
        _free.extend(self._blocks)


def _take(size: int) -> np.ndarray:
    """A free block that is large enough, but not wastefully so, or a new one."""
    needed = size + ALIGNMENT
    with _lock:
        while sum(block.nbytes for block in _free) > MOST_FREE_BYTES:
            del _free[0]
        for i, block in enumerate(_free):
            if needed <= block.nbytes <= 2 * needed:
                return _free.pop(i)
    return np.empty(needed, np.uint8)


def release() -> None:
    """Give the memory that is not in use back to the system."""
    with _lock:
        _free.clear()


def _forget_lock() -> None:
    """Another thread of the parent may have held the lock at the moment of a fork."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_lock)
