"""Which frame of a sequence is the reference and which are its targets."""

import numpy as np


def draws(seed: int, epoch: int, index: int) -> np.random.Generator:
    """The random generator of one training item: the same in whichever process and order the item is made."""
    return np.random.default_rng([seed, epoch, index])


def training_views(frames: int, targets: int, rng: np.random.Generator) -> tuple[int, list[int]]:
    """A random reference and `targets` other frames, at any baseline (Splatter Image, `scene/co3d.py:231`).

    Targets repeat only if the sequence of at least two frames is too short.
    """
    order = rng.permutation(frames)
    return int(order[0]), np.resize(order[1:], targets).tolist()


def evaluation_views(frames: int, targets: int | None) -> tuple[int, list[int]]:
    """The first frame as reference; all others as targets, or at most `targets` of them, evenly spaced."""
    others = np.arange(1, frames)
    if targets is not None and targets < len(others):
        others = others[np.round((np.arange(targets) + 0.5) * len(others) / targets - 0.5).astype(int)]
    return 0, others.tolist()
