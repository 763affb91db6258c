"""Selection of a sequence's reference frame and of its target frames."""

from dataclasses import dataclass

import numpy as np

from completesplat.errors import CompleteSplatError

Choice = tuple[int, list[int]]  # reference, targets


@dataclass(frozen=True)
class GrowingGap:
    """Largest gap in frames between two views, which grows linearly from `first` to `last` over `epochs`.

    pixelSplat's gap grows from 25 to 45 frames (`config/dataset/view_sampler_dataset_specific_config/
    bounded_re10k.yaml`).

    Raises:
        CompleteSplatError: unless 1 <= first <= last and 0 <= epochs.
    """

    first: int
    last: int
    epochs: int

    def __post_init__(self) -> None:
        if not (1 <= self.first <= self.last and self.epochs >= 0):
            raise CompleteSplatError("data.max_gap: needs 1 <= first <= last and 0 <= epochs")

    def at(self, epoch: int) -> int:
        return round(self.first + (self.last - self.first) * min(epoch / max(self.epochs, 1), 1))


def item_generator(seed: int, epoch: int, index: int) -> np.random.Generator:
    """Return the random generator of one training item, independent of the process and of the loading order."""
    return np.random.default_rng([seed, epoch, index])


def training_views(frames: int, targets: int, rng: np.random.Generator) -> Choice:
    """Draw a random reference and `targets` other frames at any baseline (Splatter Image, `scene/co3d.py:231`).

    The sequence needs at least two frames. Targets repeat only if it is too short.
    """
    order = rng.permutation(frames)
    return int(order[0]), np.resize(order[1:], targets).tolist()


def spread_around(frames: int, reference: int, count: int) -> list[int]:
    """Return `count` other frames, evenly spread over the sequence as a ring, starting after the reference.

    They repeat if the sequence has fewer other frames.
    """
    steps = 1 + (np.arange(count) + 0.5) * (frames - 1) / max(count, 1)
    return ((reference + np.floor(steps).astype(int).clip(1, frames - 1)) % frames).tolist()


def draw_spread_views(frames: int, targets: int, rng: np.random.Generator) -> Choice:
    """Draw a random reference; return it and `targets` frames all around it (`spread_around`) in random order."""
    reference = int(rng.integers(frames))
    return reference, rng.permutation(spread_around(frames, reference, targets)).tolist()


def evaluation_views(frames: int, targets: int | None) -> Choice:
    """Return the first frame as reference, and all others or at most `targets` evenly spaced ones as targets."""
    others = np.arange(1, frames)
    if targets is not None and targets < len(others):
        others = others[np.round((np.arange(targets) + 0.5) * len(others) / targets - 0.5).astype(int)]
    return 0, others.tolist()


def nearby_views(frames: int, targets: int, min_gap: int, max_gap: int, rng: np.random.Generator) -> Choice:
    """Draw a random reference and `targets` random frames that are `min_gap` to `max_gap` frames before or after it.

    Only frames that have such a neighbour can be the reference. The sequence needs at least two frames; if it is too
    short for `min_gap`, its first or last frame is the reference. Targets repeat if there are too few neighbours.
    """
    nearest = min(min_gap, frames - 1)
    positions = np.arange(frames)
    reference = int(rng.choice(positions[np.maximum(positions, frames - 1 - positions) >= nearest]))
    gap = np.abs(positions - reference)
    return reference, np.resize(rng.permutation(positions[(gap >= nearest) & (gap <= max_gap)]), targets).tolist()


def evaluation_views_within(frames: int, targets: int, gap: int) -> Choice:
    """Return the first frame as reference and `targets` evenly spaced frames, the last one `gap` frames after it.

    In a shorter sequence the last target is the last frame. Targets repeat if there are too few frames.
    """
    return 0, np.ceil(min(gap, frames - 1) * np.arange(1, targets + 1) / targets).astype(int).tolist()
