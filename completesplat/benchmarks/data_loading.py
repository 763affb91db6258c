"""`completesplat bench data`: reading speeds of published and packed forms of the same scenes."""

import logging
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal, NamedTuple, TypedDict

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


class Rooms(TypedDict):
    """Clips in the layout of RealEstate10K: `write(out=...)` writes them, and `data(...)` makes their data module."""

    write: Callable[..., Path]
    data: MakeData


class Epoch(NamedTuple):
    """Numbers of batches, scenes and images of one epoch, and the seconds that reading them took."""

    seconds: float
    batches: int
    scenes: int
    images: int


def run(
    objects: Objects, rooms: Rooms | Literal[False],
    workers: Annotated[Sequence[Natural], Entries(1)], repeats: Positive,
    codecs: Annotated[Sequence[Annotated[str, OneOf(tuple(CODECS))]], Entries(1)], out: Path,
) -> None:  # fmt: skip
    """Write scenes, read them in all their forms, write `data.json`, and print tables.

    Args:
        objects, rooms: makers of scenes and of their data modules; False skips the rooms.
        workers: numbers of loading processes; everything is measured once with each number.
        repeats: number of timed epochs of each form.
        codecs: codecs of the packed stores.
    """
    # Without this, each of dozens of data modules would log its number of sequences.
    logger = logging.getLogger("completesplat.data")
    level = logger.level
    logger.setLevel(logging.WARNING)
    results: dict[str, list[Row]] = {}
    try:
        with TemporaryDirectory(prefix="bench_data_", dir=out) as folder:
            # Write everything before reading anything, because writing shows its own progress bars.
            forms = {"rows": _objects(objects, codecs, Path(folder))}
            if rooms:
                forms["clips"] = _rooms(rooms, codecs, Path(folder))
            with Console(stderr=True).status("reading") as status:
                for key, makers in forms.items():
                    results[key] = rows(makers, workers, repeats, lambda text: status.update(f"reading {text}"))
    finally:
        logger.setLevel(level)
    titles = {"rows": "Training batches", "clips": "Training batches of clips"}
    report(out / "data.json", results, {titles[key]: taken for key, taken in results.items()})


def _objects(settings: Objects, codecs: Sequence[str], folder: Path) -> dict[str, MakeData]:
    """Write objects in all forms; return makers of their data modules by form, the published form first."""
    settings["write"](out=folder / "objects")
    data, references = partial(settings["data"], root=str(folder / "objects")), settings["references_per_sequence"]
    packed = partial(data, references_per_sequence=references["prepared"])
    raw = partial(data, references_per_sequence=references["raw"])
    return {"raw": raw, **prepared(packed, folder / "prepared objects", codecs)}


def _rooms(settings: Rooms, codecs: Sequence[str], folder: Path) -> dict[str, MakeData]:
    root = settings["write"](out=folder / "rooms")
    text = partial(settings["data"], root=str(root / "text"))
    return {"text": text, **prepared(text, folder / "prepared rooms", codecs)}


def prepared(data: MakeData, folder: Path, codecs: Sequence[str]) -> dict[str, MakeData]:
    """Pack the training sequences of a data module into `folder`, once with each codec.

    Returns:
        Makers of the modules that read the prepared forms, by name.
    """
    module = data()
    sources, settings = {"train": module.source("train")}, module.packed_settings()
    return {
        f"prepared {codec}": partial(data, root=str(prepare(sources, settings, folder / codec, codec)))
        for codec in codecs
    }


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
