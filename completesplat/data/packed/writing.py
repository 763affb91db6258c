"""Making a packed store: planned, estimated, written by several processes, continued after a break."""

import hashlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.filesize import decimal
from rich.progress import Progress

from completesplat.atomic import atomic_path
from completesplat.data.packed.manifest import (
    HEADER,
    MANIFEST,
    PackedManifest,
    Refusal,
    Scalar,
    Shard,
    Split,
    differences,
    is_packed,
    parsed,
    write_json,
)
from completesplat.data.packed.rows import CODECS, EncodedPicture, encode_picture, features, to_row
from completesplat.data.processes import map_in_processes
from completesplat.data.sequences import SPLITS, PosedSequence, SequenceSource, spread_places
from completesplat.data.validation import TooFewFrames, at, field, read_json
from completesplat.errors import CompleteSplatError, DataError

FEWEST_FRAMES = 2
UNFINISHED = ".unfinished"
PLAN = "plan.json"
# The estimate of a store's size looks at so many sequences, and frames of each.
SEQUENCES, FRAMES = 3, 2
# Cameras, depth range, number, checksum and two offsets of a frame.
BYTES_PER_FRAME = 8 * (16 + 9 + 1 + 1 + 1 + 2)

OnBad = Literal["raise", "skip"]

logger = logging.getLogger(__name__)


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
            DiskError: the disk is full.
        """
        # Public within `datasets`, though not in its handbook: the documented ways (`from_list`, `from_generator`)
        # hold a whole shard in memory or write it into a cache first.
        from datasets.arrow_writer import ArrowWriter

        path = self.folder / plan.file
        refused: list[Refusal] = []
        sequences, frames = [], 0
        # One record batch for each sequence, so that writing holds no more than one in memory.
        with atomic_path(path, f"{path.name}{UNFINISHED}") as unfinished:
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
            with unfinished.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        shard = Shard(plan.file, digest, path.stat().st_size, frames, tuple(sequences))
        record = ShardRecord(plan.split, plan.names, shard, tuple(refused))
        write_json(_record_path(path), record)
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

    def kept_record(self, plan: ShardPlan) -> ShardRecord | None:
        """The record of a shard that an earlier run has made as it should be, or None.

        A shard from which something is missing does not count where bad input is to be raised.
        """
        path = self.folder / plan.file
        try:
            record: ShardRecord = parsed(ShardRecord, read_json(_record_path(path)))
        except DataError:
            return None
        whole = path.is_file() and path.stat().st_size == record.shard.bytes and record.shard.file == plan.file
        refused = record.refused and self.on_bad == "raise"
        return record if whole and record.names == plan.names and not refused else None

    def plans(self, sequences_per_shard: int) -> list[ShardPlan]:
        """Which sequences go into which shard; those of one group of a source stay together as far as they fit."""
        plans = []
        for split, source in self.sources.items():
            parts = _parts(source, sequences_per_shard)
            files = [f"{split}-{number:05d}-of-{len(parts):05d}.arrow" for number in range(len(parts))]
            plans += [ShardPlan(file, split, names) for file, names in zip(files, parts, strict=True)]
        return plans


def _record_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


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


def _check_space(writer: ShardWriter, plans: Sequence[ShardPlan]) -> None:
    """Say how large the shards are going to be, from a few sequences; `DataError` if the disk has less space."""
    names = [(plan.split, name) for plan in plans for name in plan.names]
    frames, sizes = [], []
    for place in spread_places(len(names), SEQUENCES):
        split, name = names[place]
        # What is bad is refused and counted when the shards are made.
        try:
            sequence = writer.sources[split].read(name)
            for index in spread_places(len(sequence.frames), FRAMES):
                encoded = encode_picture(sequence, index, writer.codec)
                sizes.append(len(encoded.image) + len(encoded.mask or b""))
            frames.append(len(sequence.frames))
        except DataError:
            continue
    if not frames or not sizes:
        free = decimal(shutil.disk_usage(writer.folder).free)
        logger.warning("no estimate of the size: none of the sequences looked at can be read; %s are free", free)
        return
    count = round(float(np.mean(frames)) * len(names))
    size = round(count * (float(np.mean(sizes)) + BYTES_PER_FRAME))
    contents = f"{count:,} frames of {len(names):,} sequences in {len(plans):,} shards"
    require_space(size, contents, writer.folder)


def require_space(size: int, contents: str, folder: Path, advice: str = "") -> None:
    """Say how many bytes are going to be written for `contents`.

    Raises:
        DataError: the disk has less space than that; `advice` says how to need less.
    """
    free = shutil.disk_usage(folder).free
    needed = f"about {decimal(size)} for {contents}; {decimal(free)} are free"
    if size > free:
        raise DataError(f"not enough space: {needed}{advice}", str(folder))
    logger.info(needed)


def prepare(
    sources: Mapping[str, SequenceSource],
    settings: Mapping[str, Scalar],
    out: Path,
    codec: str = "bmp",
    sequences_per_shard: int = 32,
    workers: int | None = None,
    on_bad: OnBad = "skip",
    max_bad_fraction: float = 0.1,
    progress: bool = True,
) -> Path:
    """Write sequences into a packed store. The same input gives the same bytes, whatever the number of workers.

    An interrupted run continues when it is started again; a complete store of the same data is left as it is. A shard
    that is missing or of another size is made again. `workers` are processes, by default one for each core.

    Args:
        codec: of the images, a key of `CODECS`: "bmp" (fastest) and "png" (smaller) are without loss, "jpeg" is not.
        sequences_per_shard: some hundred MB at 128 x 128 pixels and 200 frames.
        on_bad: leave out (and record) frames and sequences that cannot be read, up to a share of each; or raise.

    Raises:
        DataError: the folder holds something else, too little space, too much or (on_bad="raise") anything bad.
    """
    if codec not in CODECS:
        raise CompleteSplatError(f"codec={codec}: choose one of {', '.join(CODECS)}")
    writer = ShardWriter({split: sources[split] for split in sorted(sources, key=SPLITS.index)}, out, codec, on_bad)
    plans = writer.plans(sequences_per_shard)
    _claim(out, _plan(writer, settings, plans))
    records = {plan: writer.kept_record(plan) for plan in plans}
    missing = [plan for plan, record in records.items() if record is None]
    if is_packed(out) and not missing:
        logger.info("%s already holds these sequences", out)
        return out
    # What the manifest says may no longer be so until it is written again.
    for path in (out / MANIFEST, *out.glob(f"*{UNFINISHED}")):
        path.unlink(missing_ok=True)
    listed = [error for source in writer.sources.values() for error in source.refused]
    if on_bad == "raise" and listed:
        raise listed[0]
    if missing:
        _check_space(writer, missing)
        with Progress(disable=not progress) as bar:
            task = bar.add_task("preparing sequences", total=sum(len(plan.names) for plan in missing))
            for plan, record in zip(missing, map_in_processes(writer.write, missing, workers), strict=True):
                bar.advance(task, len(record.names))
                records[plan] = record
    splits = {split: _split(split, source, records.values()) for split, source in writer.sources.items()}
    _finish(PackedManifest(codec, dict(settings), splits), out, max_bad_fraction)
    return out


def _plan(writer: ShardWriter, settings: Mapping[str, Scalar], plans: Sequence[ShardPlan]) -> dict[str, Any]:
    """All that the shards' bytes depend on."""
    shards = json.dumps([[plan.file, *plan.names] for plan in plans])
    return {
        "settings": dict(settings),
        "made from": {
            **HEADER,
            "codec": writer.codec,
            **{f"fingerprint of {split}": source.fingerprint() for split, source in writer.sources.items()},
            "shards": hashlib.sha256(shards.encode()).hexdigest(),
        },
    }


def _claim(out: Path, plan: dict[str, Any]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    path = out / PLAN
    if not path.is_file():
        if is_packed(out) or any(out.glob("*.arrow")):
            raise DataError("already holds other prepared sequences: choose another folder", str(out))
        write_json(path, plan)
    found = read_json(path)
    for part, wanted in plan.items():
        differing = differences(field(found, part, dict), wanted)
        if differing:
            raise DataError(f"was made with {differing}: choose another folder, or remove this one", str(out))


def _split(name: str, source: SequenceSource, made: Iterable[ShardRecord | None]) -> Split:
    records = [record for record in made if record is not None and record.split == name]
    there = {name for record in records for name in record.shard.sequences}
    return Split(
        source.fingerprint(),
        source.listed,
        tuple(name for name in source.names if name in there),
        tuple(record.shard for record in records),
        (*map(Refusal.of, source.refused), *(refusal for record in records for refusal in record.refused)),
        {reason: len(names) for reason, names in source.left_out.items()},
    )


def _finish(manifest: PackedManifest, out: Path, max_bad_fraction: float) -> None:
    """Refuse a store with too little in it, else write the manifest and say what is in it."""
    refused = [refusal for split in manifest.splits.values() for refusal in split.refused]
    shards = [shard for split in manifest.splits.values() for shard in split.shards]
    kept, frames = sum(len(shard.sequences) for shard in shards), sum(shard.frames for shard in shards)
    counts = Counter(refusal.kind for refusal in refused)
    kinds = ", ".join(f"{count:,} x {kind}" for kind, count in counts.most_common()) or "nothing"
    if not kept:
        raise DataError(f"not one sequence can be used: {kinds}", str(out))
    bad_frames = sum(refusal.frame is not None for refusal in refused)
    bad_sequences = len({refusal.sequence or refusal.file for refusal in refused if refusal.frame is None})
    share = max(bad_frames / (bad_frames + frames), bad_sequences / (bad_sequences + kept))
    if share > max_bad_fraction:
        remedy = "put the data right (then remove this folder) or raise data.max_bad_fraction"
        bad = f"{share:.1%} of the data are bad, at most {max_bad_fraction:.1%} may be ({kinds})"
        raise DataError(f"{bad}: see the .json beside the shards, and {remedy}", str(out))
    write_json(out / MANIFEST, manifest, HEADER)
    size = decimal(sum(shard.bytes for shard in shards))
    held = f"{frames:,} frames of {kept:,} sequences, {size} in {len(shards):,} shards"
    logger.info("%s: %s; refused: %s", out, held, kinds)
