"""Means over the training pictures, or over an excerpt of them where there are many."""

from collections.abc import Iterator
from contextlib import suppress

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.scenes import SceneStore
from completesplat.data.sequences import PosedSequence
from completesplat.data.typical_camera import TypicalCamera, typical_camera
from completesplat.errors import DataError

# A mean over all pictures of RealEstate10K's 66,033 training clips would take hours.
SEQUENCES, PICTURES = 400, 8192


def mean_camera(store: SceneStore) -> TypicalCamera:
    """The typical camera of at most 8,192 frames, in the first 400 sequences.

    Raises:
        DataError: none of them can be read.
    """
    chosen = list(excerpts(store))
    if not chosen:
        raise DataError("no training sequence can be read")
    return typical_camera([s.cameras[f] for s, f in chosen], [s.depth_ranges[f] for s, f in chosen])


def mean_image(store: SceneStore, size: int) -> Float[Tensor, "3 {size} {size}"]:
    """Mean of the pictures of the same frames; black if none can be read."""
    total, count = torch.zeros(3, size, size, dtype=torch.float64), 0
    for sequence, frames in excerpts(store):
        for frame in frames:
            with suppress(DataError):
                total += store.image(sequence, frame)
                count += 1
    return (total / (255 * max(count, 1))).float()


def excerpts(store: SceneStore) -> Iterator[tuple[PosedSequence, list[int]]]:
    """The first sequences that can be read, each with evenly spaced frames."""
    names = store.names[:SEQUENCES]
    most = PICTURES // len(names)
    for name in names:
        with suppress(DataError):
            sequence = store.source.read(name)
            count = len(sequence.frames)
            yield sequence, sorted({i * count // most for i in range(most)})
