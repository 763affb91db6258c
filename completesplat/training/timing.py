"""How long parts of an evaluation take, complete and warm."""

import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from typing import TypeVar

import torch

from completesplat.data.processes import gathered

Result = TypeVar("Result")


class Timings:
    """Seconds for each scene, by the name of the work."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def of(self, name: str, work: Callable[[], Result], scenes: int = 1) -> Result:
        """Do the work for so many scenes at once."""
        start = _now()
        result = work()
        self.seconds[name].append((_now() - start) / scenes)
        return result

    def gather(self) -> None:
        """Know the durations of all processes; each of them must call it."""
        own, self.seconds = self.seconds, defaultdict(list)
        for other in gathered(dict(own)):
            for name, values in other.items():
                self.seconds[name] += values

    def results(self) -> dict[str, float]:
        """Medians; the first duration is left out where there are others: it includes what happens only once."""
        return {name: statistics.median(values[1:] or values) for name, values in self.seconds.items()}


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
