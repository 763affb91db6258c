"""`completesplat bench data`: reading speeds of published and packed forms of the same scenes."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple, TypedDict

from rich.console import Console

from completesplat.benchmarks.measuring import Row, report
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.loader import SceneLoader
from completesplat.data.packed.rows import CODECS
from completesplat.data.packed.writing import prepare
from completesplat.settings.schema import Entries, Natural, OneOf, Positive

MakeData = Callable[..., SceneDataModule]  # takes the remaining settings, such as root and workers


class Objects(TypedDict):
    """Objects in the layout of CO3D.

    `write(out=...)` writes the scenes, and `data(...)` makes their data module. `references_per_sequence` gives, for
    the forms `raw` and `prepared`, how many items of an epoch come from each training sequence.
    """

    write: Callable[..., object]
    data: MakeData
    references_per_sequence: Mapping[str, int]


class Epoch(NamedTuple):
    """Numbers of batches, scenes and images of one epoch, and the seconds that reading them took."""

    seconds: float
    batches: int
    scenes: int
    images: int


def run(
    objects: Objects, workers: Annotated[Sequence[Natural], Entries(1)], repeats: Positive,
    codecs: Annotated[Sequence[Annotated[str, OneOf(tuple(CODECS))]], Entries(1)], out: Path,
) -> None:  # fmt: skip
    """Write scenes, read them in all their forms, write `data.json`, and print a table.

    `conf/bench_task/data.yaml` explains the settings.
    """
    with TemporaryDirectory(prefix="bench_data_", dir=out) as folder:
        forms = forms_of(objects, codecs, Path(folder))
        with Console(stderr=True).status("reading") as status:
            taken = rows(forms, workers, repeats, lambda text: status.update(f"reading {text}"))
    report(out / "data.json", {"rows": taken}, {"Training batches": taken})


def forms_of(settings: Objects, codecs: Sequence[str], folder: Path) -> dict[str, MakeData]:
    """Write objects; return makers of the data modules of the published form, and of a packed one for each codec."""
    settings["write"](out=folder / "objects")
    data, references = partial(settings["data"], root=str(folder / "objects")), settings["references_per_sequence"]
    forms: dict[str, MakeData] = {"raw": partial(data, references_per_sequence=references["raw"])}
    module = data()
    packed, sources = partial(data, references_per_sequence=references["prepared"]), {"train": module.source("train")}
    for codec in codecs:
        store = prepare(sources, module.packed_settings(), folder / codec, codec)
        forms[f"prepared {codec}"] = partial(packed, root=str(store))
    return forms


def rows(forms: Mapping[str, MakeData], workers: Sequence[int], repeats: int, tick: Callable[[str], None]) -> list[Row]:
    """Return a row per number of workers and form: rates of batches, scenes and images, and speed-up over the first.

    The forms take turns. The time of a form is the median of `repeats` epochs, after an untimed epoch in which workers
    start and files come into memory.
    """
    result: list[Row] = []
    for count in workers:
        loaders: dict[str, SceneLoader] = {}
        for name, make in forms.items():
            tick(f"{name}, {count} workers: first epoch")
            loaders[name] = make(workers=count).train_dataloader()
            read_epoch(loaders[name], 0)
        epochs: dict[str, list[Epoch]] = {name: [] for name in forms}
        for number in range(1, repeats + 1):
            for name, loader in loaders.items():
                tick(f"{name}, {count} workers: epoch {number} of {repeats}")
                epochs[name].append(read_epoch(loader, number))
        seconds = {name: statistics.median(epoch.seconds for epoch in taken) for name, taken in epochs.items()}
        rates = {name: [size / seconds[name] for size in epochs[name][0][1:]] for name in forms}
        first = next(iter(rates.values()))
        keys = [f"{size}_per_second" for size in Epoch._fields[1:]]
        result += [
            {"form": name, "workers": count, "epoch_seconds": seconds[name]}
            | dict(zip(keys, rate, strict=True))
            | {"times_first": rate[1] / first[1]}
            for name, rate in rates.items()
        ]
    return result


def read_epoch(loader: SceneLoader, number: int) -> Epoch:
    """Read all batches of an epoch, without using them, and time it."""
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
