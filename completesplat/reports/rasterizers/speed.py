"""Speed and memory of the backends on scenes shaped like splatter images."""

import statistics
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.reports.rasterizers.backends import Backend
from completesplat.reports.rasterizers.timing import milliseconds, peak_megabytes
from completesplat.reports.rasterizers.workloads import OPACITIES, splatter_scene

LONGEST_SECONDS = 4.0  # a backend that has taken this long on a workload is not run again on it


def rows(
    backends: Sequence[Backend], sizes: Sequence[int], views: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """One row for each backend and workload (size, number of views, kind of opacities)."""
    result = []
    for size, number, opacity in product(sizes, views, OPACITIES):
        tick(f"{size} x {size}, {number} views, {opacity}")
        gaussians, cameras = splatter_scene(size, number, opacity)
        workload = {"size": size, "gaussians": gaussians.count, "views": number, "opacity": opacity}
        figures = side_by_side(backends, gaussians, cameras, repeats)
        result += [{"backend": name} | workload | figure for name, figure in figures.items()]
    return result


def side_by_side(
    backends: Sequence[Backend], gaussians: Gaussians, cameras: Cameras, repeats: int
) -> dict[str, dict[str, Any]]:
    """Medians in ms of the forward pass and of both passes, the backends taking turns, and the peak of memory in MB.

    Memory is what a first rendering with its backward pass adds. That one is timed only where it is the only one.
    """
    pixels = cameras.image_size[0] * cameras.image_size[1] * cameras.intrinsics.shape[1]
    backends = [backend for backend in backends if backend.takes(gaussians.count, pixels)]
    times: dict[str, list[tuple[float, float]]] = {}
    peaks, spent = {}, {}
    for backend in backends:
        inputs = (backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))
        first: list[tuple[float, float]] = []
        start = time.perf_counter()
        peaks[backend.name] = peak_megabytes(lambda: first.append(milliseconds(*inputs)), backend.device)  # noqa: B023
        spent[backend.name] = time.perf_counter() - start
        times[backend.name] = first if spent[backend.name] > LONGEST_SECONDS else []
    for _, backend in product(range(repeats), backends):
        if spent[backend.name] > LONGEST_SECONDS:
            continue
        start = time.perf_counter()
        inputs = (backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))
        times[backend.name].append(milliseconds(*inputs))
        spent[backend.name] += time.perf_counter() - start
    return {name: _medians(taken) | {"peak_mb": peaks[name]} for name, taken in times.items()}


def _medians(times: list[tuple[float, float]]) -> dict[str, float]:
    forward, both = (statistics.median(column) for column in zip(*times, strict=True))
    return {"forward_ms": forward, "forward_backward_ms": both}
