"""`completesplat bench data`: reading speeds of published and packed forms of the same scenes."""

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Any, Literal, TypedDict

from rich.console import Console

from completesplat.benchmarks.printing import print_results
from completesplat.benchmarks.reading import MakeData, chunks, decoding_share, opening_figures, rows
from completesplat.commands.protocol import write_json
from completesplat.data.packed.rows import CODECS
from completesplat.data.packed.writing import prepare
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.errors import DataError
from completesplat.results.machine import machine
from completesplat.results.tables import Column, Table, table
from completesplat.settings.schema import Entries, Natural, OneOf, Positive, Range


class Opening(TypedDict):
    """Size of a store with many sequences, and the number of epochs for which it is read."""

    sequences: Annotated[int, Range(2)]  # at least one for training and one for validation
    epochs: Positive


def run(
    objects: Mapping[str, Any],
    rooms: Mapping[str, Any] | Literal[False],
    opening: Opening | Literal[False],
    workers: Annotated[Sequence[Natural], Entries(1)],
    repeats: Positive,
    codecs: Annotated[Sequence[Annotated[str, OneOf(tuple(CODECS))]], Entries(1)],
    keep: bool,
    out: Path,
) -> None:
    """Write scenes, read them in all their forms, write `data.json`, and print tables.

    Args:
        objects: `write` (out) makes the scenes, `data` (settings) their data module. `references_per_sequence` holds
            the number of items of each training sequence in an epoch, for the forms `raw` and `prepared`.
        rooms: `write` and `data` of clips, and `read_chunk`, the name of the function that reads a chunk of them; False
            skips them.
        opening: the store of many sequences; False skips it.
        workers: numbers of loading processes; everything is measured with each of them.
        repeats: number of timed epochs of each form.
        codecs: codecs of the packed stores; the store of many sequences has the first one.
        keep: whether to keep the files that were read in `out`.
    """
    folder = Path(mkdtemp(prefix="bench_data_", dir=out))
    try:
        with _warnings_only("completesplat.data"):
            # Write everything before reading anything, because writing shows its own progress bars.
            forms = _objects(objects, codecs, folder)
            clips = _rooms(rooms, codecs, folder) if rooms else {}
            store = _store(forms, opening["sequences"], codecs[0], folder) if opening else None
            with Console(stderr=True).status("reading") as status:
                measure = partial(_rows, workers, repeats, lambda text: status.update(f"reading {text}"))
                figures: dict[str, Any] = {"rows": measure(forms, decoding=True)}
                if opening and store is not None:
                    status.update("reading many sequences in a fresh process")
                    measured = opening_figures(store, opening["epochs"])
                    figures["opening"] = {"sequences": opening["sequences"], **measured}
                if rooms:
                    figures["clips"] = measure(clips, decoding=False)
                    figures["chunks"] = chunks(clips["chunks"](workers=0), rooms["read_chunk"])
    finally:
        if not keep:
            shutil.rmtree(folder)
    results = {"machine": machine(), "not_measured": {}, **figures}
    if "opening" in figures and "added_mb" not in figures["opening"]:
        results["not_measured"] = {"memory": "this system has no /proc/self/status"}
    write_json(out / "data.json", results)
    show(results)


@contextmanager
def _warnings_only(name: str) -> Iterator[None]:
    """Limit a logger to warnings, because dozens of data modules would log their numbers of sequences."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(before)


def _objects(settings: Mapping[str, Any], codecs: Sequence[str], folder: Path) -> dict[str, MakeData]:
    """Write objects in all forms; return makers of their data modules by form, the published form first."""
    settings["write"](out=folder / "objects")
    data = partial(settings["data"], root=str(folder / "objects"))
    references = settings["references_per_sequence"]
    packed = prepared(
        partial(data, references_per_sequence=references["prepared"]), folder / "prepared objects", codecs
    )
    return {"raw": partial(data, references_per_sequence=references["raw"]), **packed}


def _rooms(settings: Mapping[str, Any], codecs: Sequence[str], folder: Path) -> dict[str, MakeData]:
    root = settings["write"](out=folder / "rooms")
    chunks, text = (partial(settings["data"], root=str(root / form)) for form in ("chunks", "text"))
    return {"chunks": chunks, "text": text, **prepared(text, folder / "prepared rooms", codecs)}


def _store(objects: Mapping[str, MakeData], sequences: int, codec: str, folder: Path) -> MakeData:
    few = partial(objects[f"prepared {codec}"], references_per_sequence=1)
    return repeated(few, sequences, folder / "many", codec)


def _rows(
    workers: Sequence[int], repeats: int, tick: Callable[[str], None], forms: Mapping[str, MakeData], decoding: bool
) -> list[dict[str, Any]]:
    """Return the rates of all forms; with `decoding`, also its share of the time if the main process loads."""
    results = rows(forms, workers, repeats, tick)
    for name, make in forms.items() if decoding else ():
        tick(f"{name}: time in decoding")
        share = decoding_share(make(workers=0).train_dataloader())
        for row in results:
            if (row["form"], row["workers"]) == (name, 0):
                row["decoding_share"] = share
    return results


VALIDATION_SHARE = 0.1


def prepared(data: MakeData, folder: Path, codecs: Sequence[str]) -> dict[str, MakeData]:
    """Prepare the training sequences of a data module once with each codec.

    Args:
        data: makes the module from the settings that are still open, such as its number of workers.
        folder: the folder above the prepared forms.

    Returns:
        Makers of the modules that read the prepared forms, by name.
    """
    module = data()
    sources, settings = {"train": module.source("train")}, module.packed_settings()
    return {
        f"prepared {codec}": partial(data, root=str(prepare(sources, settings, folder / codec, codec)))
        for codec in codecs
    }


def repeated(data: MakeData, sequences: int, folder: Path, codec: str) -> MakeData:
    """Write a packed store of `sequences` sequences that repeat a module's few; return its module's maker."""
    module = data()
    validation = max(1, round(VALIDATION_SHARE * sequences))
    counts = {"train": sequences - validation, "val": validation}
    sources = {split: RepeatedSource(module.source("train"), count) for split, count in counts.items()}
    return partial(data, root=str(prepare(sources, module.packed_settings(), folder, codec)))


@dataclass
class RepeatedSource(SequenceSource):
    """Source of `count` sequences that repeat those of another source under new names."""

    source: SequenceSource
    count: int
    refused: list[DataError] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = [f"{number:06d}" for number in range(self.count)]
        self.listed = self.count

    def read(self, name: str) -> PosedSequence:
        """Read a sequence of the other source under this name."""
        originals = self.source.names
        return replace(self.source.read(originals[int(name) % len(originals)]), name=name)

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """Return one group with all sequences."""
        return [list(range(len(names)))]

    def fingerprint(self) -> str:
        """Return the fingerprint of the other source."""
        return self.source.fingerprint()


READING: list[Column] = [
    ("form", "form", ""),
    ("workers", "workers", "d"),
    ("batches\nper s", "batches_per_second", ",.1f"),
    ("scenes\nper s", "scenes_per_second", ",.0f"),
    ("images\nper s", "images_per_second", ",.0f"),
    ("times\nthe first", "times_first", ",.1f"),
]
DECODING: Column = ("share of\ndecoding", "decoding_share", ".0%")
STEPS: list[Column] = [
    ("after", "after", ""),
    ("seconds", "seconds", ",.2f"),
    ("own memory\nMB", "anonymous_mb", ",.0f"),
    ("mapped files\nMB", "file_mb", ",.0f"),
]


def show(results: dict[str, Any]) -> None:
    """Print all parts of the results."""
    sections: list[Table | str] = [table("Training batches", [*READING, DECODING], results["rows"])]
    if "opening" in results:
        opening = results["opening"]
        sections.append(table(f"A packed store of {opening['sequences']:,} sequences", STEPS, opening["steps"]))
    if "clips" in results:
        sections.append(table("Training batches of clips", READING, results["clips"]))
        chunks = results["chunks"]
        size, read, most = chunks["largest_mb"], chunks["read_in_an_epoch"], chunks["most_in_memory"]
        sections.append(
            f"{chunks['files']} chunks of up to {size:.1f} MB: {read} read in an epoch, {most} in memory at once"
        )
    machine = results["machine"]
    print_results(results, f"{machine['processor']}, {machine['cores']} cores", sections)
