"""Writer of a packed store, by several processes, with continuation after an interruption."""

import hashlib
import json
import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
from rich.filesize import decimal
from rich.progress import Progress

from completesplat.data.packed.manifest import (
    FORMAT,
    HEADER,
    MANIFEST,
    PackedManifest,
    Refusal,
    Scalar,
    Shard,
    Split,
    differences,
    is_packed,
)
from completesplat.data.packed.rows import CODECS, SCHEMA, encode_image, to_row
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.splits import SPLITS
from completesplat.data.tolerance import ErrorTolerance
from completesplat.data.validation import field, parsed, read_json
from completesplat.data.validation.processes import map_in_processes
from completesplat.errors import CompleteSplatError, DataError, TooFewFrames, refused_to
from completesplat.files import atomic_path, write_json
from completesplat.weights import sha256_of
from completesplat.wording import counted

FEWEST_FRAMES = 2
UNFINISHED = ".unfinished"
PLAN = "plan.json"

logger = logging.getLogger(__name__)


class ShardPlan(NamedTuple):
    """File name and sequences of a shard to be written."""

    file: str
    split: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class ShardRecord:
    """Report of one shard, as JSON beside it: sequences planned and written, and errors of those that are missing."""

    split: str
    names: tuple[str, ...]
    shard: Shard
    refused: tuple[Refusal, ...]


@dataclass(frozen=True)
class ShardWriter:
    """Writer of shards in `folder`. It is pickled for the worker processes, with its sources."""

    sources: Mapping[str, SequenceSource]
    folder: Path
    codec: str
    tolerance: ErrorTolerance

    def write(self, plan: ShardPlan) -> ShardRecord:
        """Write a shard and then its record, each atomically.

        Raises:
            DataError: something cannot be read, and nothing may be skipped.
            DiskError: the disk is full.
        """
        path = self.folder / plan.file
        refused: list[Refusal] = []
        names = []
        frames = 0
        # One record batch for each sequence, so that memory holds only one sequence.
        with atomic_path(path, f"{path.name}{UNFINISHED}") as unfinished:
            with unfinished.open("wb") as stream, pa.ipc.new_stream(stream, SCHEMA) as writer:
                for name in plan.names:
                    with refused_to(partial(self._refuse, refused), sequence=name):
                        row = self._encode(self.sources[plan.split].read(name), refused)
                        writer.write_table(row)
                        names.append(name)
                        frames += len(row["frames"][0])
            digest = sha256_of(unfinished)
        shard = Shard(plan.file, digest, path.stat().st_size, frames, tuple(names))
        record = ShardRecord(plan.split, plan.names, shard, tuple(refused))
        write_json(_record_path(path), asdict(record))
        return record

    def _encode(self, sequence: PosedSequence, refused: list[Refusal]) -> pa.Table:
        usable = []
        images = []
        for index, number in enumerate(sequence.frames):
            with refused_to(partial(self._refuse, refused), frame=number, sequence=sequence.name):
                images.append(encode_image(sequence, index, self.codec))
                usable.append(index)
        if len(usable) < FEWEST_FRAMES:
            raise TooFewFrames(f"{len(usable)} usable frames of {len(sequence.frames)}, {FEWEST_FRAMES} are needed")
        return to_row(sequence, usable, images)

    def _refuse(self, refused: list[Refusal], error: DataError) -> None:
        self.tolerance.check(error)
        refused.append(Refusal.of(error))

    def finished_record(self, plan: ShardPlan) -> ShardRecord | None:
        """Return the record of a shard that an earlier run wrote, or None. It has no errors if none may be skipped."""
        path = self.folder / plan.file
        with suppress(DataError):
            record: ShardRecord = parsed(ShardRecord, read_json(_record_path(path)))
            same = record.shard.file == plan.file and record.names == plan.names
            whole = path.is_file() and path.stat().st_size == record.shard.bytes
            accepted = not record.refused or self.tolerance.on_bad == "skip"
            return record if same and whole and accepted else None
        return None


def _record_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _plans(sources: Mapping[str, SequenceSource], sequences_per_shard: int) -> list[ShardPlan]:
    """Assign sequences to shards. A group of a source stays in one shard if it fits."""
    plans = []
    for split, source in sources.items():
        shards: list[tuple[str, ...]] = []
        for group in source.groups(source.names):
            # A group that exceeds a shard is divided into nearly equal parts.
            count = math.ceil(len(group) / sequences_per_shard)
            edges = [round(len(group) * number / count) for number in range(count + 1) if count]
            for start, end in pairwise(edges):
                names = tuple(source.names[index] for index in group[start:end])
                if shards and len(shards[-1]) + len(names) <= sequences_per_shard:
                    shards[-1] += names
                else:
                    shards.append(names)
        for number, names in enumerate(shards):
            plans.append(ShardPlan(f"{split}-{number:05d}-of-{len(shards):05d}.arrow", split, names))
    return plans


def prepare(
    sources: Mapping[str, SequenceSource],
    settings: Mapping[str, Scalar],
    out: Path,
    codec: str = "bmp",
    sequences_per_shard: int = 32,
    workers: int | None = None,
    tolerance: ErrorTolerance = ErrorTolerance(),  # noqa: B008
    progress: bool = True,
) -> Path:
    """Write sequences into a packed store. Its bytes depend on the input only, not on the number of workers.

    A run that is started again keeps a complete store, or only writes shards that are missing or of another size.

    Args:
        codec: image codec, a key of `CODECS`: "bmp" (fastest) and "png" (smaller) are lossless, "jpeg" is not.
        sequences_per_shard: the default gives a few hundred MB at 128 x 128 pixels and 200 frames.
        workers: processes; None: one for each core.
        tolerance: rule for unreadable frames and sequences; those that are skipped are recorded.

    Raises:
        DataError: the folder holds something else, or too much is unreadable.
        DiskError: the disk is full; a run that is started again keeps the finished shards.
    """
    if codec not in CODECS:
        raise CompleteSplatError(f"codec={codec}: choose one of {', '.join(CODECS)}")
    ordered = {split: sources[split] for split in sorted(sources, key=SPLITS.index)}
    writer = ShardWriter(ordered, out, codec, tolerance)
    plans = _plans(writer.sources, sequences_per_shard)
    _claim(out, _plan(writer, settings, plans))
    records = {plan: writer.finished_record(plan) for plan in plans}
    missing = [plan for plan, record in records.items() if record is None]
    if is_packed(out) and not missing:
        logger.info("%s already holds these sequences", out)
        return out
    # The old manifest may be wrong until it is written again.
    for path in (out / MANIFEST, *out.glob(f"*{UNFINISHED}")):
        path.unlink(missing_ok=True)
    for source in writer.sources.values():
        for error in source.refused:
            tolerance.check(error)
    if missing:
        records.update(_write_shards(writer, missing, workers, progress))
    splits = {}
    for split, source in writer.sources.items():
        written = [record for record in records.values() if record is not None and record.split == split]
        splits[split] = _split(source, written)
    _finish(PackedManifest(codec, dict(settings), splits), out, tolerance.max_bad_fraction)
    return out


def _write_shards(
    writer: ShardWriter, plans: list[ShardPlan], workers: int | None, progress: bool
) -> dict[ShardPlan, ShardRecord]:
    records = {}
    with Progress(disable=not progress) as bar:
        task = bar.add_task("preparing sequences", total=sum(len(plan.names) for plan in plans))
        for plan, record in zip(plans, map_in_processes(writer.write, plans, workers), strict=True):
            bar.advance(task, len(record.names))
            records[plan] = record
    return records


def _plan(writer: ShardWriter, settings: Mapping[str, Scalar], plans: list[ShardPlan]) -> dict[str, dict[str, Scalar]]:
    """Return everything that determines the shards' bytes."""
    shards = json.dumps([[plan.file, *plan.names] for plan in plans])
    made_from: dict[str, Scalar] = {"format": FORMAT, "codec": writer.codec}
    for split, source in writer.sources.items():
        made_from[f"fingerprint of {split}"] = source.fingerprint()
    made_from["shards"] = hashlib.sha256(shards.encode()).hexdigest()
    return {"settings": dict(settings), "made from": made_from}


def _claim(out: Path, plan: Mapping[str, Mapping[str, Scalar]]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    path = out / PLAN
    if not path.is_file():
        if is_packed(out) or any(out.glob("*.arrow")):
            raise DataError("already holds other prepared sequences: choose another folder", str(out))
        write_json(path, plan)
    existing = read_json(path)
    for part, wanted in plan.items():
        differing = differences(field(existing, part, dict), wanted)
        if differing:
            raise DataError(f"was made with {differing}: choose another folder, or remove this one", str(out))


def _split(source: SequenceSource, records: Sequence[ShardRecord]) -> Split:
    """Return the manifest's entry of a split from its source and the records of its shards."""
    stored = {name for record in records for name in record.shard.sequences}
    refused = [Refusal.of(error) for error in source.refused]
    for record in records:
        refused.extend(record.refused)
    return Split(
        fingerprint=source.fingerprint(),
        listed=source.listed,
        names=tuple(name for name in source.names if name in stored),
        shards=tuple(record.shard for record in records),
        refused=tuple(refused),
        left_out={reason: len(names) for reason, names in source.left_out.items()},
    )


def _finish(manifest: PackedManifest, out: Path, max_bad_fraction: float) -> None:
    """Write the manifest and log a summary, or refuse a store with too many errors or no sequences."""
    refused = [refusal for split in manifest.splits.values() for refusal in split.refused]
    shards = [shard for split in manifest.splits.values() for shard in split.shards]
    sequences = sum(len(shard.sequences) for shard in shards)
    frames = sum(shard.frames for shard in shards)
    counts = Counter(refusal.kind for refusal in refused)
    kinds = ", ".join(f"{count:,} x {kind}" for kind, count in counts.most_common()) or "nothing"
    if not sequences:
        raise DataError(f"not one sequence can be used: {kinds}", str(out))
    share = _bad_share(refused, sequences, frames)
    if share > max_bad_fraction:
        remedy = "put the data right (then remove this folder) or raise data.max_bad_fraction"
        bad = f"{share:.1%} of the data are bad, at most {max_bad_fraction:.1%} may be ({kinds})"
        raise DataError(f"{bad}: see the .json beside the shards, and {remedy}", str(out))
    write_json(out / MANIFEST, {**HEADER, **asdict(manifest)})
    size = decimal(sum(shard.bytes for shard in shards))
    held = f"{counted(frames, 'frame')} of {counted(sequences, 'sequence')}, {size} in {counted(len(shards), 'shard')}"
    logger.info("%s: %s; refused: %s", out, held, kinds)


def _bad_share(refused: Sequence[Refusal], sequences: int, frames: int) -> float:
    """Return the share of refused frames or of refused sequences, the larger one, given the numbers of the others."""
    of_sequences = {refusal.sequence or refusal.file for refusal in refused if refusal.frame is None}
    bad_frames = sum(refusal.frame is not None for refusal in refused)
    bad_sequences = len(of_sequences)
    return max(bad_frames / (bad_frames + frames), bad_sequences / (bad_sequences + sequences))
