"""Two ways to do the same work, timed side by side."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from completesplat.errors import CompleteSplatError

WARM_UP = 2

Work = Callable[[], object]


class NotMeasured(CompleteSplatError):
    """Why there are no figures of a comparison on this machine."""


@dataclass(frozen=True)
class Comparison:
    """Two ways, each with a few words for tables; the first is the one that should be faster."""

    name: str
    a: tuple[str, Work]
    b: tuple[str, Work]


def measured(comparison: Comparison, repeats: int, device: torch.device) -> dict[str, Any]:
    """A row: medians in ms of both, which take turns, and how many times faster `a` is than `b`.

    The first two of each are not counted.
    """
    ways = {"a": comparison.a, "b": comparison.b}
    times: dict[str, list[float]] = {key: [] for key in ways}
    for _ in range(WARM_UP + repeats):
        for key, (_, work) in ways.items():
            times[key].append(milliseconds(work, device))
    medians = {f"{key}_ms": statistics.median(taken[WARM_UP:]) for key, taken in times.items()}
    texts = {key: text for key, (text, _) in ways.items()}
    return {"name": comparison.name, **texts, **medians, "ratio": medians["b_ms"] / medians["a_ms"]}


def milliseconds(work: Work, device: torch.device) -> float:
    """Of one call, until the device has finished it."""
    wait = torch.cuda.synchronize if device.type == "cuda" else _nothing
    wait()
    start = time.perf_counter()
    work()
    wait()
    return (time.perf_counter() - start) * 1e3


def _nothing() -> None: ...
