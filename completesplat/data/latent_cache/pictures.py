"""The pictures that are to be encoded, read by several processes; and how much room their encodings will need."""

import logging
import shutil
from collections.abc import Iterator
from contextlib import suppress
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from rich.filesize import decimal
from rich.progress import track
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from completesplat.data.latent_cache.manifest import Sequence
from completesplat.data.sequences import SequenceSource
from completesplat.data.validation import at
from completesplat.errors import DataError

SEQUENCES_OF_ESTIMATE = 8

logger = logging.getLogger(__name__)


class Found(NamedTuple):
    """What there is of one sequence.

    Attributes:
        frames: how many it has; 0 if it cannot be read as a whole.
        stored: places of the frames whose pictures could be read.
        numbers: of these frames in the data set.
        pictures: of these frames; None if there are none.
    """

    name: str
    frames: int
    stored: tuple[int, ...]
    numbers: tuple[int, ...]
    pictures: UInt8[Tensor, "frame 3 size size"] | None
    refused: tuple[DataError, ...]


class Picture(NamedTuple):
    """A picture that is to be encoded, and the frame it is of."""

    image: UInt8[Tensor, "3 size size"]
    sequence: str
    number: int


def evenly_spaced(count: int, most: int | None) -> list[int]:
    """At most so many of `count` places: the middles of equal parts; None: all."""
    if most is None or most >= count:
        return list(range(count))
    return [(2 * part + 1) * count // (2 * most) for part in range(most)]


class SequencePictures(IterableDataset):
    """Every sequence of a source once, group by group; worker processes have groups of their own."""

    def __init__(self, source: SequenceSource, frames: int | None) -> None:
        self.source = source
        self.frames = frames
        groups = source.groups(source.names)
        self.groups = groups if len(groups) > 1 else [[index] for group in groups for index in group]

    def __iter__(self) -> Iterator[Found]:
        worker = get_worker_info()
        first, step = (worker.id, worker.num_workers) if worker else (0, 1)
        for group in self.groups[first::step]:
            for index in group:
                yield self._find(self.source.names[index])

    def _find(self, name: str) -> Found:
        stored, pictures, refused = [], [], []
        try:
            sequence = self.source.read(name)
        except DataError as error:
            return Found(name, 0, (), (), None, (error,))
        for place in evenly_spaced(len(sequence.frames), self.frames):
            try:
                with at(sequence=name, frame=sequence.frames[place]):
                    pictures.append(sequence.read(place).image)
                stored.append(place)
            except DataError as error:
                refused.append(error)
        numbers = tuple(sequence.frames[place] for place in stored)
        stacked = torch.stack(pictures) if pictures else None
        return Found(name, len(sequence.frames), tuple(stored), numbers, stacked, tuple(refused))


class Reading:
    """Reads all sequences of a source once, and keeps account of what there is and what cannot be read.

    Args:
        frames: at most so many evenly spaced frames of a sequence; None: all.
        workers: processes that read; 0: this one.
        on_bad: "raise" what cannot be read, or "skip" it.
        most_bad: the largest share of frames, and of sequences, that may be skipped.

    Attributes:
        sequences: as they will be stored, by name, those that were read so far.
    """

    def __init__(
        self, source: SequenceSource, frames: int | None, workers: int, on_bad: str, most_bad: float, progress: bool
    ) -> None:
        self.source = source
        self.on_bad = on_bad
        self.most_bad = most_bad
        self.progress = progress
        self.sequences: dict[str, Sequence] = {}
        self.refused = list(source.refused)
        self.rows = self.bad_frames = 0
        # Its own generator, so that what the caller draws does not depend on the number of workers.
        self._loader = DataLoader(
            SequencePictures(source, frames),
            batch_size=None,
            num_workers=workers,
            collate_fn=_unchanged,
            generator=torch.Generator(),
        )

    def __iter__(self) -> Iterator[Picture]:
        """The pictures, in the order of the rows that they are to be stored in.

        Raises:
            DataError: something cannot be read and is not to be skipped, or too much of it, or all.
        """
        total = len(self.source.names)
        for found in track(self._loader, "encoding sequences", total, disable=not self.progress):
            self.refused += found.refused
            if self.refused and self.on_bad == "raise":
                raise self.refused[0]
            self.sequences[found.name] = Sequence(found.name, found.frames, self.rows, found.stored)
            self.rows += len(found.stored)
            self.bad_frames += len(found.refused) if found.frames else 0
            if found.pictures is not None:
                yield from map(Picture, found.pictures, repeat(found.name), found.numbers)
        self._check_share()

    def _check_share(self) -> None:
        if not self.rows:
            raise DataError(f"not one picture can be read; the first: {self.refused[0] if self.refused else 'none'}")
        empty = len(self.source.refused) + sum(not sequence.stored for sequence in self.sequences.values())
        shares = (
            self.bad_frames / (self.bad_frames + self.rows),
            empty / (len(self.source.refused) + len(self.sequences)),
        )
        if max(shares) > self.most_bad:
            raise DataError(
                f"{max(shares):.1%} of the {'sequences' if shares[1] > shares[0] else 'frames'} cannot be read, more "
                f"than data.most_bad={self.most_bad:g} allows; the first: {self.refused[0]}"
            )
        if self.refused:
            logger.warning("skipped %d that cannot be read; the first: %s", len(self.refused), self.refused[0])

    def stored(self) -> tuple[Sequence, ...]:
        """All sequences, in the order of the source."""
        return tuple(self.sequences[name] for name in self.source.names)


def _unchanged(found: Any) -> Any:
    return found


def check_space(source: SequenceSource, frames: int | None, bytes_per_frame: int, folder: Path) -> None:
    """Say how large the store is going to be, from the number of frames of some sequences.

    Raises:
        DataError: the disk has less space than that.
    """
    counts = []
    for place in evenly_spaced(len(source.names), SEQUENCES_OF_ESTIMATE):
        with suppress(DataError):
            counts.append(len(evenly_spaced(len(source.read(source.names[place]).frames), frames)))
    free = shutil.disk_usage(folder).free
    if not counts:
        logger.warning("no estimate of the size: none of the sequences looked at can be read")
        return
    total = round(float(np.mean(counts)) * len(source.names))
    size = total * bytes_per_frame
    needed = f"about {decimal(size)} for {total:,} frames of {len(source.names):,} sequences; {decimal(free)} are free"
    if size > free:
        raise DataError(f"not enough space: {needed}; frames=N takes fewer frames of a sequence", str(folder))
    logger.info(needed)
