"""How fast training batches come, from one form of the same scenes and another."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from completesplat.data.loading import SceneLoader

# Settings of a data module that are still open (workers, ...) -> the data module.
MakeData = Callable[..., Any]


class Epoch(NamedTuple):
    """What one epoch gave, in how many seconds."""

    seconds: float
    batches: int
    scenes: int
    images: int


def rows(
    forms: Mapping[str, MakeData], workers: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """One row for each number of workers and form: batches, scenes and images per second, and times the first form.

    All forms take turns. Of each, the median of `repeats` epochs counts, after an untimed one in which workers start
    and files come into memory.
    """
    result = []
    for count in workers:
        loaders = {}
        for name, make in forms.items():
            tick(f"{name}, {count} workers: first epoch")
            loaders[name] = make(workers=count).train_dataloader()
            read_epoch(loaders[name], 0)
        epochs: dict[str, list[Epoch]] = {name: [] for name in forms}
        for number in range(1, repeats + 1):
            for name, loader in loaders.items():
                tick(f"{name}, {count} workers: epoch {number} of {repeats}")
                epochs[name].append(read_epoch(loader, number))
        rates = {name: _rates(taken) for name, taken in epochs.items()}
        first = rates[next(iter(forms))]["scenes_per_second"]
        result += [
            {"form": name, "workers": count} | rate | {"times_first": rate["scenes_per_second"] / first}
            for name, rate in rates.items()
        ]
    return result


def read_epoch(loader: SceneLoader, number: int) -> Epoch:
    """Read all batches of an epoch and do nothing with them."""
    if loader.sampler is not None:
        loader.sampler.set_epoch(number)
    batches = scenes = images = 0
    start = time.perf_counter()
    for batch in loader:
        count, targets = batch.targets.images.shape[:2]
        batches += 1
        scenes += count
        images += count * (1 + targets)
    return Epoch(time.perf_counter() - start, batches, scenes, images)


def _rates(epochs: Sequence[Epoch]) -> dict[str, float]:
    seconds = statistics.median(epoch.seconds for epoch in epochs)
    first = epochs[0]
    return {
        "epoch_seconds": seconds,
        "batches_per_second": first.batches / seconds,
        "scenes_per_second": first.scenes / seconds,
        "images_per_second": first.images / seconds,
    }
