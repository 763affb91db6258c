"""Opening a prepared store of many sequences in a fresh process, and what training from it keeps in memory."""

import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from typing import Any

from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.errors import DataError
from completesplat.reports.loading.epochs import MakeData, read_epoch
from completesplat.reports.loading.memory import resident_megabytes


@dataclass
class RepeatedSource:
    """`count` sequences: those of another source again and again, under new names. See `SequenceSource`."""

    source: SequenceSource
    count: int
    refused: list[DataError] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = [f"{number:06d}" for number in range(self.count)]
        self.listed = self.count

    def read(self, name: str) -> PosedSequence:
        """A sequence of the other source under this name."""
        originals = self.source.names
        return replace(self.source.read(originals[int(name) % len(originals)]), name=name)

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """All in one."""
        return [list(range(len(names)))]

    def fingerprint(self) -> str:
        """That of the other source."""
        return self.source.fingerprint()


def opening(make: MakeData, epochs: int) -> dict[str, Any]:
    """Open a data module in a new process, and read its training items for some epochs there.

    Returns:
        `seconds` to open it (train and val); `added_mb`, resident then above the imports; `growth_mb` of anonymous
        memory from the first epoch's end to the last one's; `steps` with resident memory after each. No memory is given
        where the system does not tell.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        steps = pool.submit(_steps, make, epochs).result()
    result = {"seconds": steps[1]["seconds"], "scenes": steps[2]["scenes"]}
    if "anonymous_mb" in steps[0]:
        result["added_mb"] = _resident(steps[1]) - _resident(steps[0])
        result["growth_mb"] = steps[-1]["anonymous_mb"] - steps[2]["anonymous_mb"]
    return result | {"steps": steps}


def _resident(step: dict[str, Any]) -> float:
    return float(step["anonymous_mb"] + step["file_mb"])


def _steps(make: MakeData, epochs: int) -> list[dict[str, Any]]:
    """One entry after the imports, one after opening, one after each epoch."""
    import datasets  # noqa: F401  which the store itself imports with its first sequence

    steps = [_step("imports")]
    start = time.perf_counter()
    data = make(workers=0)
    data.setup("fit")
    steps.append(_step("opening", seconds=time.perf_counter() - start))
    loader = data.train_dataloader()
    for number in range(epochs):
        epoch = read_epoch(loader, number)
        steps.append(_step(f"epoch {number + 1}", seconds=epoch.seconds, scenes=epoch.scenes))
    return steps


def _step(name: str, **figures: float) -> dict[str, Any]:
    resident = resident_megabytes() or {}
    return {"after": name, **figures, **{f"{kind}_mb": value for kind, value in resident.items()}}
