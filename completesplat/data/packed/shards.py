"""Making one shard of a packed store, in whichever process."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch

from completesplat.data.packed.manifest import Refusal, Shard, refusal_from_json, shard_from_json, write_json
from completesplat.data.packed.rows import EncodedPicture, encode_picture, features, to_row
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.validation import TooFewFrames, at, field, read_json
from completesplat.errors import DataError

FEWEST_FRAMES = 2
UNFINISHED = ".unfinished"

OnBad = Literal["raise", "skip"]


@dataclass(frozen=True)
class ShardPlan:
    """A shard's file and the sequences that are to be in it."""

    file: str
    split: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class ShardRecord:
    """What became of a shard: what it holds, and what it does not. Lies beside it as JSON."""

    split: str
    names: tuple[str, ...]
    shard: Shard
    refused: tuple[Refusal, ...]


@dataclass(frozen=True)
class ShardWriter:
    """Makes shards in `folder`; it travels to the worker processes, the sources with it."""

    sources: Mapping[str, SequenceSource]
    folder: Path
    codec: str
    on_bad: OnBad

    def write(self, plan: ShardPlan) -> ShardRecord:
        """Make a shard and, after it, its record; either is there as a whole or not at all.

        Raises:
            DataError: something cannot be read, and bad input is not to be skipped.
        """
        # Public within `datasets`, though not in its handbook: the documented ways (`from_list`, `from_generator`)
        # hold a whole shard in memory or write it into a cache first.
        from datasets.arrow_writer import ArrowWriter

        path = self.folder / plan.file
        unfinished = path.with_name(path.name + UNFINISHED)
        refused: list[Refusal] = []
        sequences, frames = [], 0
        # One record batch for each sequence, so that writing holds no more than one in memory.
        with (
            unfinished.open("wb") as stream,
            ArrowWriter(features=features(), stream=stream, writer_batch_size=1) as writer,
        ):
            for name in plan.names:
                try:
                    sequence, kept, pictures = self._encode(plan.split, name, refused)
                except DataError as error:
                    self._refuse(error, refused)
                    continue
                writer.write_table(to_row(sequence, kept, pictures))
                sequences.append(name)
                frames += len(kept)
            writer.finalize()
        digest = _flush_and_digest(unfinished)
        unfinished.rename(path)
        shard = Shard(plan.file, digest, path.stat().st_size, frames, tuple(sequences))
        record = ShardRecord(plan.split, plan.names, shard, tuple(refused))
        write_json(record_path(path), asdict(record))
        return record

    def _encode(
        self, split: str, name: str, refused: list[Refusal]
    ) -> tuple[PosedSequence, list[int], list[EncodedPicture]]:
        with at(sequence=name):
            sequence = self.sources[split].read(name)
            kept, pictures = [], []
            for index, number in enumerate(sequence.frames):
                try:
                    with at(sequence=name, frame=number):
                        pictures.append(encode_picture(sequence, index, self.codec))
                    kept.append(index)
                except DataError as error:
                    self._refuse(error, refused)
            if len(kept) < FEWEST_FRAMES:
                raise TooFewFrames(f"{len(kept)} usable frames of {len(sequence.frames)}, {FEWEST_FRAMES} are needed")
            return sequence, kept, pictures

    def _refuse(self, error: DataError, refused: list[Refusal]) -> None:
        if self.on_bad == "raise":
            raise error
        refused.append(Refusal.of(error))


def record_path(path: Path) -> Path:
    """Where a shard's record lies."""
    return path.with_name(f"{path.name}.json")


def kept_record(folder: Path, plan: ShardPlan, on_bad: OnBad) -> ShardRecord | None:
    """The record of a shard that an earlier run has made as it should be, or None.

    A shard from which something is missing does not count where bad input is to be raised.
    """
    path = folder / plan.file
    try:
        content = read_json(record_path(path))
        shard = shard_from_json(folder, field(content, "shard", dict))
        refused = tuple(refusal_from_json(entry) for entry in field(content, "refused", list))
        names = tuple(field(content, "names", list))
    except DataError:
        return None
    whole = path.is_file() and path.stat().st_size == shard.bytes and shard.file == plan.file
    if not whole or names != plan.names or (refused and on_bad == "raise"):
        return None
    return ShardRecord(plan.split, names, shard, refused)


def cut(sources: Mapping[str, SequenceSource], sequences_per_shard: int) -> list[ShardPlan]:
    """Which sequences go into which shard; those of one group of a source stay together as far as they fit."""
    plans = []
    for split, source in sources.items():
        parts = _parts(source, sequences_per_shard)
        plans += [
            ShardPlan(f"{split}-{number:05d}-of-{len(parts):05d}.arrow", split, names)
            for number, names in enumerate(parts)
        ]
    return plans


def _parts(source: SequenceSource, most: int) -> list[tuple[str, ...]]:
    parts: list[tuple[str, ...]] = []
    for group in source.groups(source.names):
        names = [source.names[index] for index in group]
        # A group that does not fit into one shard is cut into nearly equal parts.
        count = -(-len(names) // most)
        edges = [round(len(names) * number / count) for number in range(count + 1)] if count else []
        for start, end in pairwise(edges):
            part = tuple(names[start:end])
            if parts and len(parts[-1]) + len(part) <= most:
                parts[-1] += part
            else:
                parts.append(part)
    return parts


def _flush_and_digest(path: Path) -> str:
    with path.open("rb+") as file:
        os.fsync(file.fileno())  # The record must not outlive a shard that a power cut took.
        return hashlib.file_digest(file, "sha256").hexdigest()


_writer: ShardWriter | None = None


def start_worker(writer: ShardWriter) -> None:
    """Remember in a new process what its shards are made from."""
    global _writer
    torch.set_num_threads(1)  # There is one process for each core.
    _writer = writer


def write_in_worker(plan: ShardPlan) -> ShardRecord:
    """`ShardWriter.write` in a process that `start_worker` has prepared."""
    assert _writer is not None
    return _writer.write(plan)
