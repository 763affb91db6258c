"""Time and memory of one rendering with its backward pass."""

import ctypes
import mmap
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.kernels import buffers

SAMPLING_SECONDS = 2e-3
MEBIBYTE = 2**20


def milliseconds(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Of the forward pass, and of both passes with gradients to all parameters of the Gaussians."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    ones = [_ones(cameras, channels) for channels in (3, 1, 1)]
    wait = torch.cuda.synchronize if gaussians.means.is_cuda else _nothing
    wait()
    start = time.perf_counter()
    rendering = rasterizer(gaussians, cameras)
    wait()
    middle = time.perf_counter()
    torch.autograd.backward([rendering.color, rendering.depth, rendering.alpha], ones)
    wait()
    return (middle - start) * 1e3, (time.perf_counter() - start) * 1e3


def _ones(cameras: Cameras, channels: int) -> Tensor:
    # By NumPy: torch would wake its own threads, which then spin for a while on the cores that are to be timed.
    ones = np.ones((*cameras.intrinsics.shape[:2], channels, *cameras.image_size), np.float32)
    return torch.from_numpy(ones).to(cameras.intrinsics.device)


def _nothing() -> None: ...


def peak_megabytes(work: Callable[[], object], device: str) -> float | None:
    """What `work` adds to the memory of the process, or of the GPU; None where the system does not tell.

    The memory of the process is read from /proc every 2 ms, and once more at the end.
    """
    _return_free_memory()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return (torch.cuda.max_memory_allocated() - before) / MEBIBYTE
    statm = Path("/proc/self/statm")
    if not statm.exists():
        work()
        return None
    samples: list[int] = []
    started, done = threading.Event(), threading.Event()

    def watch() -> None:
        last = False
        while not last:
            last = done.is_set()
            samples.append(int(statm.read_text().split()[1]))
            started.set()
            done.wait(SAMPLING_SECONDS)

    watcher = threading.Thread(target=watch)
    watcher.start()
    started.wait()
    try:
        work()
    finally:
        done.set()
        watcher.join()
    return (max(samples) - samples[0]) * mmap.PAGESIZE / MEBIBYTE


def _return_free_memory() -> None:
    """Otherwise memory that was freed earlier, but is still held by the process, would not be counted again."""
    buffers.release()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # of glibc
