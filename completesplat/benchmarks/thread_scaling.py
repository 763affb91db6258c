"""Speed of the CPU rasterizer with several threads."""

import os
import statistics
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import torch

from completesplat.benchmarks.workloads import Backend, milliseconds, splatter_scene
from completesplat.results.tables import Column

COLUMNS: list[Column] = [
    ("size", "size", ""),
    ("Gaussians", "gaussians", ","),
    ("views", "views", ""),
    ("threads", "threads", ""),
    ("forward\nms", "forward_ms", ",.2f"),
    ("efficiency", "forward_efficiency", ".0%"),
    ("with backward\nms", "forward_backward_ms", ",.2f"),
    ("efficiency", "efficiency", ".0%"),
]


def scaling_rows(
    backend: Backend, threads: Sequence[int], sizes: Sequence[int], views: Sequence[int], repeats: int,
    tick: Callable[[str], None],
) -> list[dict[str, Any]]:  # fmt: skip
    """Return a row for each workload and each number of threads up to the machine's cores, including 1.

    Times are medians; the numbers of threads take turns. The efficiency of n threads is the time of one thread divided
    by n times theirs, which is 100 % if n threads take an n-th of the time.
    """
    numbers = sorted({1, *(number for number in threads if number <= (os.cpu_count() or 1))})
    result, before = [], torch.get_num_threads()
    try:
        for size, number in product(sizes, views):
            tick(f"{size} x {size}, {number} views, with {', '.join(map(str, numbers))} threads")
            gaussians, cameras = splatter_scene(size, number, "trained")
            times: dict[int, list[tuple[float, float]]] = {count: [] for count in numbers}
            for turn, count in product(range(repeats + 1), numbers):
                torch.set_num_threads(count)
                taken = milliseconds(backend.rasterizer, gaussians, cameras)
                if turn:  # the first turn starts the threads
                    times[count].append(taken)
            workload = {"size": size, "gaussians": gaussians.count, "views": number}
            result += [workload | row for row in _efficiencies(times)]
    finally:
        torch.set_num_threads(before)
    return result


def _efficiencies(times: dict[int, list[tuple[float, float]]]) -> list[dict[str, float]]:
    """Return rows from times (forward, both passes) by the number of threads, the first of which is 1."""
    medians = {
        count: [statistics.median(column) for column in zip(*taken, strict=True)] for count, taken in times.items()
    }
    rows = []
    for count, (forward, both) in medians.items():
        rows.append(
            {
                "threads": count,
                "forward_ms": forward,
                "forward_efficiency": medians[1][0] / (count * forward),
                "forward_backward_ms": both,
                "efficiency": medians[1][1] / (count * both),
            }
        )
    return rows
