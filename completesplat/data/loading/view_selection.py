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
        """Return the gap of an epoch."""
        progress = min(epoch / max(self.epochs, 1), 1)
        return round(self.first + (self.last - self.first) * progress)


@dataclass(frozen=True)
class ObjectViews:
    """Views of a sequence that surrounds an object.

    Args:
        targets: number of targets of a training scene.
        spread_targets: spread them around the reference (`draw_spread_views`); false: draw them at random.
        test_targets: largest number of evenly spaced targets of a test scene; None: all other frames.
        validation_targets: the same for validation; None: as for a test.
    """

    targets: int
    spread_targets: bool
    test_targets: int | None
    validation_targets: int | None

    def training(self, frames: int, rng: np.random.Generator) -> Choice:
        """Draw reference and targets of a training scene."""
        draw = draw_spread_views if self.spread_targets else training_views
        return draw(frames, self.targets, rng)

    def evaluation(self, frames: int, split: str) -> Choice:
        """Return the first frame as reference and others as targets."""
        return evaluation_views(frames, self.targets_of(split))

    def targets_of(self, split: str) -> int | None:
        """Return the largest number of targets of a scene of "val" or "test"; None: all other frames."""
        if split == "val" and self.validation_targets is not None:
            return self.validation_targets
        return self.test_targets

    def described_targets(self) -> str:
        """Return the targets of a test in words."""
        return "its other frames" if self.test_targets is None else f"{self.test_targets} others"


@dataclass(frozen=True)
class ClipViews:
    """Views of a video clip, near to its reference.

    Args:
        min_gap, max_gap: smallest and largest distance in frames from the reference to a training target.
        evaluation_targets: number of evenly spaced targets of validation and test.
        evaluation_gap: distance of the last of them from the reference.
    """

    min_gap: int
    max_gap: GrowingGap
    evaluation_targets: int
    evaluation_gap: int

    def __post_init__(self) -> None:
        if not 1 <= self.min_gap <= self.max_gap.first:
            raise CompleteSplatError("data: needs 1 <= min_gap <= max_gap")

    def training(self, frames: int, targets: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Draw reference and targets of a training scene."""
        return nearby_views(frames, targets, self.min_gap, self.max_gap.at(epoch), rng)

    def evaluation(self, frames: int) -> Choice:
        """Return the first frame as reference, and targets after it."""
        return evaluation_views_within(frames, self.evaluation_targets, self.evaluation_gap)

    def described(self) -> str:
        """Return the views of a test in words."""
        targets = f"{self.evaluation_targets} targets, the last {self.evaluation_gap} frames away"
        return f"reference: first frame; {targets}"


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
    """Draw a random reference, and `targets` frames all around it (`spread_around`) in random order."""
    reference = int(rng.integers(frames))
    return reference, rng.permutation(spread_around(frames, reference, targets)).tolist()


def evaluation_views(frames: int, targets: int | None) -> Choice:
    """Return the first frame as reference, and all others or at most `targets` evenly spaced ones as targets."""
    candidates = np.arange(1, frames)
    if targets is None or targets >= len(candidates):
        return 0, candidates.tolist()
    middles = (np.arange(targets) + 0.5) * len(candidates) / targets
    return 0, candidates[np.round(middles - 0.5).astype(int)].tolist()


def nearby_views(frames: int, targets: int, min_gap: int, max_gap: int, rng: np.random.Generator) -> Choice:
    """Draw a random reference and `targets` random frames that are `min_gap` to `max_gap` frames before or after it.

    Only frames that have such a neighbour can be the reference. The sequence needs at least two frames; if it is too
    short for `min_gap`, its first or last frame is the reference. Targets repeat if there are too few neighbours.
    """
    nearest = min(min_gap, frames - 1)
    positions = np.arange(frames)
    reference = int(rng.choice(positions[np.maximum(positions, frames - 1 - positions) >= nearest]))
    gap = np.abs(positions - reference)
    neighbours = positions[(gap >= nearest) & (gap <= max_gap)]
    return reference, np.resize(rng.permutation(neighbours), targets).tolist()


def evaluation_views_within(frames: int, targets: int, gap: int) -> Choice:
    """Return the first frame as reference and `targets` evenly spaced frames, the last one `gap` frames after it.

    In a shorter sequence the last target is the last frame. Targets repeat if there are too few frames.
    """
    last = min(gap, frames - 1)
    return 0, np.ceil(last * np.arange(1, targets + 1) / targets).astype(int).tolist()
