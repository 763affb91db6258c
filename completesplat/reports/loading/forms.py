"""The same sequences in several forms on disk."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from completesplat.data.prepared.writing import prepare
from completesplat.reports.loading.epochs import MakeData
from completesplat.reports.loading.opening import RepeatedSource

VALIDATION_SHARE = 0.1


def prepared(data: MakeData, folder: Path, codecs: Sequence[str]) -> dict[str, MakeData]:
    """Prepare the training sequences of a data module once with each codec.

    Args:
        data: the module, but for its number of workers; other settings may follow.
        folder: what is made lies below it.

    Returns:
        By name, the module that reads the prepared form.
    """
    module = data()
    sources, settings = {"train": module.source("train")}, module.prepared_settings()
    return {
        f"prepared {codec}": partial(data, root=str(prepare(sources, settings, folder / codec, codec)))
        for codec in codecs
    }


def repeated(data: MakeData, sequences: int, folder: Path, codec: str) -> MakeData:
    """A prepared store of so many sequences for training and validation, made of a module's few training sequences."""
    module = data()
    validation = max(1, round(VALIDATION_SHARE * sequences))
    counts = {"train": sequences - validation, "val": validation}
    sources = {split: RepeatedSource(module.source("train"), count) for split, count in counts.items()}
    return partial(data, root=str(prepare(sources, module.prepared_settings(), folder, codec)))
