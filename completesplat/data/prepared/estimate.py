"""How large a prepared store will be, told from a few of its frames."""

import logging
import shutil
from collections.abc import Sequence

import numpy as np
from rich.filesize import decimal

from completesplat.data.prepared.rows import encode_picture
from completesplat.data.prepared.shards import ShardPlan, ShardWriter
from completesplat.errors import DataError

SEQUENCES, FRAMES = 3, 2
# Cameras, depth range, number, checksum and two offsets of a frame.
BYTES_PER_FRAME = 8 * (16 + 9 + 1 + 1 + 1 + 2)

logger = logging.getLogger(__name__)


def check_space(writer: ShardWriter, plans: Sequence[ShardPlan]) -> None:
    """Say how large the shards are going to be, from two frames of each of three sequences.

    Raises:
        DataError: the disk has less space than that.
    """
    names = [(plan.split, name) for plan in plans for name in plan.names]
    frames, sizes = [], []
    for place in _spread(len(names), SEQUENCES):
        split, name = names[place]
        # What is bad is refused and counted when the shards are made.
        try:
            sequence = writer.sources[split].read(name)
            for index in _spread(len(sequence.frames), FRAMES):
                encoded = encode_picture(sequence, index, writer.codec)
                sizes.append(len(encoded.image) + len(encoded.mask or b""))
            frames.append(len(sequence.frames))
        except DataError:
            continue
    free = shutil.disk_usage(writer.folder).free
    if not frames or not sizes:
        logger.warning(
            "no estimate of the size: none of the sequences looked at can be read; %s are free", decimal(free)
        )
        return
    count = round(float(np.mean(frames)) * len(names))
    size = round(count * (float(np.mean(sizes)) + BYTES_PER_FRAME))
    needed = (
        f"about {decimal(size)} for {count:,} frames of {len(names):,} sequences in {len(plans):,} shards; "
        f"{decimal(free)} are free"
    )
    if size > free:
        raise DataError(f"not enough space: {needed}", str(writer.folder))
    logger.info(needed)


def _spread(count: int, most: int) -> list[int]:
    """At most so many of `count` numbers, evenly spread: the middles of equal parts."""
    parts = min(most, count)
    return [int((part + 0.5) * count / parts) for part in range(parts)]
