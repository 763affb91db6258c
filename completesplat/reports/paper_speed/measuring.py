"""Durations and memory of works on one device."""

import gc
import statistics
from collections.abc import Callable, Mapping
from typing import Any

import torch

from completesplat.reports.diffusion.comparing import WARM_UP, milliseconds
from completesplat.reports.paper_speed.figures import FIGURES
from completesplat.reports.paper_speed.ways import Way

MEGABYTE = 1e6


def rows(
    way: Way, works: Mapping[str, Callable[[], object]], repeats: int, device: torch.device, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """A row for each work: median ms, and on a GPU the most memory that torch held, weights included, in MB.

    What fails, for want of memory, say, has the reason in its row instead.
    """
    found = []
    for name, work in works.items():
        tick(f"{way.name}: {FIGURES[name].text}")
        row: dict[str, Any] = {"name": name, "way": way.name}
        try:
            found.append(row | _measured(work, repeats, device))
        except (RuntimeError, AssertionError) as error:  # both kinds come from torch's compiler, too
            first = (str(error).strip().splitlines() or [""])[0]
            found.append(row | {"not_measured": f"{type(error).__name__}: {first}"})
        gc.collect()
    return found


def _measured(work: Callable[[], object], repeats: int, device: torch.device) -> dict[str, Any]:
    on_gpu = device.type == "cuda"
    for _ in range(WARM_UP):
        work()
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    times = [milliseconds(work, device) for _ in range(repeats)]
    memory = {"memory_mb": torch.cuda.max_memory_allocated(device) / MEGABYTE} if on_gpu else {}
    return {"ms": statistics.median(times), **memory}
