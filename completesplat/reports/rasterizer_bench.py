"""Speed and memory of the rasterizers on scenes shaped like splatter images."""

import ctypes
import mmap
import platform
import statistics
import threading
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.kernels import buffers
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.reports.splatter_workload import splatter_scene

BACKENDS: dict[str, type] = {"reference": ReferenceRasterizer, "tiled": TiledRasterizer}
REFERENCE_WORKLOAD = (64, 1)  # the only size and number of views at which the reference is timed: it takes seconds
SAMPLING_SECONDS = 2e-3
MEBIBYTE = 2**20


def run(sizes: Sequence[int], views: Sequence[int], repeats: int, backends: Sequence[str]) -> dict[str, Any]:
    """Time the forward pass, and both passes with gradients to all parameters; medians in ms.

    Backends take turns. `peak_mb` is what a first rendering with its backward pass adds to the memory of the
    process, None where the system does not tell (it is read from /proc).
    """
    rows = []
    for size, number, opacity in product(sizes, views, ("trained", "initial")):
        gaussians, cameras = splatter_scene(size, number, opacity)
        timed = [name for name in backends if name != "reference" or (size, number) == REFERENCE_WORKLOAD]
        rasterizers = {name: BACKENDS[name]() for name in timed}
        for rasterizer in rasterizers.values():
            _milliseconds(rasterizer, *splatter_scene(8, 1, opacity))  # compiles what has to be
        peaks = {name: _peak_megabytes(rasterizer, gaussians, cameras) for name, rasterizer in rasterizers.items()}
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in timed}
        for _, name in product(range(repeats), timed):
            times[name].append(_milliseconds(rasterizers[name], gaussians, cameras))
        for name in timed:
            forward, both = (statistics.median(column) for column in zip(*times[name], strict=True))
            row = {"backend": name, "size": size, "gaussians": gaussians.count, "views": number, "opacity": opacity}
            rows.append(row | {"forward_ms": forward, "forward_backward_ms": both, "peak_mb": peaks[name]})
    return {"machine": _machine(), "rows": rows}


def table(results: dict[str, Any]) -> Table:
    """The rows of `run`, for people."""
    machine = results["machine"]
    shown = Table(title=f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']}")
    for heading in ("backend", "size", "Gaussians", "views", "opacity", "forward\nms", "with backward\nms", "peak\nMB"):
        shown.add_column(heading, justify="left" if heading in ("backend", "opacity") else "right")
    for row in results["rows"]:
        figures = [row["forward_ms"], row["forward_backward_ms"], row["peak_mb"]]
        cells = [str(row[key]) for key in ("backend", "size", "gaussians", "views", "opacity")]
        shown.add_row(*cells, *("" if figure is None else format(figure, ".1f") for figure in figures))
    return shown


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }


def _milliseconds(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Of the forward pass, and of both passes."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    shape = cameras.intrinsics.shape[:2]
    # By NumPy: torch would wake its own threads, which then spin for a while on the cores that are to be timed.
    ones = [np.ones((*shape, channels, *cameras.image_size), np.float32) for channels in (3, 1, 1)]
    start = time.perf_counter()
    rendering = rasterizer(gaussians, cameras)
    middle = time.perf_counter()
    images = [rendering.color, rendering.depth, rendering.alpha]
    torch.autograd.backward(images, [torch.from_numpy(array) for array in ones])
    return (middle - start) * 1e3, (time.perf_counter() - start) * 1e3


def _peak_megabytes(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> float | None:
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return None
    _return_free_memory()
    samples: list[int] = []
    done = threading.Event()

    def watch() -> None:
        while not samples or not done.wait(SAMPLING_SECONDS):
            samples.append(int(statm.read_text().split()[1]))

    watch_thread = threading.Thread(target=watch)
    watch_thread.start()
    while not samples:
        time.sleep(SAMPLING_SECONDS)
    _milliseconds(rasterizer, gaussians, cameras)
    done.set()
    watch_thread.join()
    return (max(samples) - samples[0]) * mmap.PAGESIZE / MEBIBYTE


def _return_free_memory() -> None:
    """Otherwise memory that was freed earlier, but is still held by the process, would not be counted again."""
    buffers.release()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)
