"""Making a packed store: planned, estimated, written by several processes, continued after a break."""

import hashlib
import json
import logging
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.filesize import decimal
from rich.progress import Progress

from completesplat.data.packed.manifest import (
    FORMAT,
    MANIFEST,
    PackedManifest,
    Refusal,
    Scalar,
    Split,
    differences,
    is_packed,
    write_json,
    write_manifest,
)
from completesplat.data.packed.rows import CODECS, encode_picture
from completesplat.data.packed.shards import (
    UNFINISHED,
    OnBad,
    ShardPlan,
    ShardRecord,
    ShardWriter,
    cut,
    kept_record,
    start_worker,
    write_in_worker,
)
from completesplat.data.sequences import SPLITS, SequenceSource, spread_places
from completesplat.data.validation import field, read_json
from completesplat.errors import CompleteSplatError, DataError

SEQUENCES, FRAMES = 3, 2
# Cameras, depth range, number, checksum and two offsets of a frame.
BYTES_PER_FRAME = 8 * (16 + 9 + 1 + 1 + 1 + 2)
PLAN = "plan.json"

logger = logging.getLogger(__name__)


def check_space(writer: ShardWriter, plans: Sequence[ShardPlan]) -> None:
    """Say how large the shards are going to be, from two frames of each of three sequences.

    Raises:
        DataError: the disk has less space than that.
    """
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
    """Say how many bytes are going to be written.

    Args:
        contents: what they are for.
        advice: how to need less, appended to the error.

    Raises:
        DataError: the disk has less space than that.
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
    that is missing or of another size is made again.

    Args:
        sources: by split.
        settings: what is baked into the pictures and cameras, for those who read them.
        codec: of the images, a key of `CODECS`: "bmp" (fastest) and "png" (smaller) are without loss, "jpeg" is not.
        sequences_per_shard: some hundred MB at 128 x 128 pixels and 200 frames.
        workers: processes; by default one for each core.
        on_bad: leave out frames and sequences that cannot be read, and record that; or raise.
        max_bad_fraction: the largest share of frames, and of sequences, that may be left out so.

    Returns:
        The folder.

    Raises:
        DataError: the folder holds something else, too little space, too much or (on_bad="raise") anything bad.
    """
    if codec not in CODECS:
        raise CompleteSplatError(f"codec={codec}: choose one of {', '.join(CODECS)}")
    writer = ShardWriter({split: sources[split] for split in sorted(sources, key=SPLITS.index)}, out, codec, on_bad)
    plans = cut(writer.sources, sequences_per_shard)
    _claim(out, _plan(writer, settings, plans))
    records = {plan: kept_record(out, plan, on_bad) for plan in plans}
    missing = [plan for plan, record in records.items() if record is None]
    if is_packed(out) and not missing:
        logger.info("%s already holds these sequences", out)
        return out
    _remove_unfinished(out)
    listed = [error for source in writer.sources.values() for error in source.refused]
    if on_bad == "raise" and listed:
        raise listed[0]
    if missing:
        check_space(writer, missing)
        records.update(zip(missing, _write_all(writer, missing, workers, progress), strict=True))
    _finish(writer, settings, [record for record in records.values() if record is not None], max_bad_fraction)
    return out


def _plan(writer: ShardWriter, settings: Mapping[str, Scalar], plans: Sequence[ShardPlan]) -> dict[str, Any]:
    """All that the shards' bytes depend on."""
    shards = json.dumps([[plan.file, *plan.names] for plan in plans])
    return {
        "settings": dict(settings),
        "made from": {
            "format": FORMAT,
            "codec": writer.codec,
            **{f"fingerprint of {split}": source.fingerprint() for split, source in writer.sources.items()},
            "shards": hashlib.sha256(shards.encode()).hexdigest(),
        },
    }


def _claim(out: Path, plan: dict[str, Any]) -> None:
    path = out / PLAN
    if not path.is_file():
        if is_packed(out) or any(out.glob("*.arrow")):
            raise DataError("already holds other prepared sequences: choose another folder", str(out))
        out.mkdir(parents=True, exist_ok=True)
        write_json(path, plan)
    found = read_json(path)
    for part, wanted in plan.items():
        differing = differences(field(found, part, dict), wanted)
        if differing:
            raise DataError(f"was made with {differing}: choose another folder, or remove this one", str(out))


def _remove_unfinished(out: Path) -> None:
    # What it says may no longer be so until it is written again.
    (out / MANIFEST).unlink(missing_ok=True)
    for path in out.glob(f"*{UNFINISHED}"):
        path.unlink()


def _write(writer: ShardWriter, plans: Sequence[ShardPlan], workers: int) -> Iterator[ShardRecord]:
    if workers == 1:
        yield from map(writer.write, plans)
        return
    spawn = get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=start_worker, initargs=(writer,)) as pool:
        try:
            yield from pool.map(write_in_worker, plans)
        except BrokenProcessPool:
            advice = "run the same command again, with fewer workers, to continue"
            raise CompleteSplatError(f"a worker process ended unexpectedly (out of memory?): {advice}") from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _write_all(
    writer: ShardWriter, plans: Sequence[ShardPlan], workers: int | None, progress: bool
) -> Iterator[ShardRecord]:
    workers = min(workers or os.cpu_count() or 1, len(plans))
    with Progress(disable=not progress) as bar:
        task = bar.add_task("preparing sequences", total=sum(len(plan.names) for plan in plans))
        for record in _write(writer, plans, workers):
            bar.advance(task, len(record.names))
            yield record


def _finish(
    writer: ShardWriter, settings: Mapping[str, Scalar], records: Sequence[ShardRecord], max_bad_fraction: float
) -> None:
    splits = {
        split: _split(source, [record for record in records if record.split == split])
        for split, source in writer.sources.items()
    }
    manifest = PackedManifest(writer.folder, writer.codec, dict(settings), splits)
    _check_share(manifest, max_bad_fraction)
    write_manifest(manifest)
    _report(manifest)


def _check_share(manifest: PackedManifest, max_bad_fraction: float) -> None:
    splits, out = manifest.splits.values(), str(manifest.root)
    refused = [refusal for split in splits for refusal in split.refused]
    kept, kinds = sum(len(split.names) for split in splits), _by_kind(refused)
    if not kept:
        raise DataError(f"not one sequence can be used: {kinds}", out)
    bad_frames = sum(refusal.frame is not None for refusal in refused)
    bad_sequences = len({refusal.sequence or refusal.file for refusal in refused if refusal.frame is None})
    frames = sum(shard.frames for split in splits for shard in split.shards)
    share = max(bad_frames / (bad_frames + frames), bad_sequences / (bad_sequences + kept))
    if share > max_bad_fraction:
        remedy = "put the data right (then remove this folder) or raise data.max_bad_fraction"
        advice = f"see the .json beside the shards, and {remedy}"
        raise DataError(
            f"{share:.1%} of the data are bad, at most {max_bad_fraction:.1%} may be ({kinds}): {advice}", out
        )


def _split(source: SequenceSource, records: Sequence[ShardRecord]) -> Split:
    there = {name for record in records for name in record.shard.sequences}
    refused = [Refusal.of(error) for error in source.refused]
    return Split(
        source.fingerprint(),
        source.listed,
        tuple(name for name in source.names if name in there),
        tuple(record.shard for record in records),
        (*refused, *(refusal for record in records for refusal in record.refused)),
        {reason: len(names) for reason, names in source.left_out.items()},
    )


def _by_kind(refused: Sequence[Refusal]) -> str:
    counts = Counter(refusal.kind for refusal in refused)
    return ", ".join(f"{count:,} x {kind}" for kind, count in counts.most_common()) or "nothing"


def _report(manifest: PackedManifest) -> None:
    splits = manifest.splits.values()
    shards = [shard for split in splits for shard in split.shards]
    sequences, frames = sum(len(shard.sequences) for shard in shards), sum(shard.frames for shard in shards)
    size, refused = (
        decimal(sum(shard.bytes for shard in shards)),
        [entry for split in splits for entry in split.refused],
    )
    logger.info(
        "%s: %s frames of %s sequences, %s in %s shards; refused: %s",
        *(manifest.root, f"{frames:,}", f"{sequences:,}", size, f"{len(shards):,}", _by_kind(refused)),
    )
