"""Splits of a data set into training, validation and test, by hash or seed, and sequences that two splits share."""

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

from completesplat.data.sequences import first_names
from completesplat.errors import DataError
from completesplat.wording import counted

SPLITS = ("train", "val", "test")
FEWEST_SEQUENCES = 3  # one for each split

ListedFrames = dict[str, set[tuple[str, int]]]
"""(sequence name, frame number) of each split."""


class SeededSplit(NamedTuple):
    """Shares of the sequences that are held out by seed, at least one sequence for each share.

    They are shares of all sequences. Where a list defines the splits and has no validation, `val_fraction` is taken
    from training.
    """

    val_fraction: float
    test_fraction: float
    split_seed: int


def split_by_seed(frames: Mapping[str, Iterable[int]], rule: SeededSplit) -> ListedFrames:
    """Split at least three sequences by seed, each as a whole. A `test_fraction` of 1 tests all, however many.

    Raises:
        DataError: there are too few sequences for three splits.
    """
    tests_all = rule.test_fraction >= 1
    if len(frames) < FEWEST_SEQUENCES and not tests_all:
        sequences = counted(len(frames), "sequence")
        raise DataError(f"{sequences} cannot be split into train, val and test; write a list (data.splits=FILE)")
    least_train = 0 if tests_all else 1
    least_val = 0 if tests_all else 1
    rest, test = split_by_hash(sorted(frames), rule.test_fraction, rule.split_seed, least_train + least_val)
    # The hashes of the remaining names lie above the test fraction, so validation gets the next interval.
    train, val = split_by_hash(rest, rule.test_fraction + rule.val_fraction, rule.split_seed, least_train)
    splits: ListedFrames = {}
    for split, names in zip(SPLITS, (train, val, test), strict=True):
        splits[split] = {(name, number) for name in names for number in frames[name]}
    return splits


def split_by_hash(names: Sequence[str], fraction: float, seed: int, least: int = 0) -> tuple[list[str], list[str]]:
    """Return training and held-out sequences in the order of `names`.

    A sequence's side depends only on its name and the seed, so it does not change when sequences are added. If no
    sequence would be held out, the one with the smallest hash is. The `least` ones with the largest hashes are training
    sequences in any case.
    """
    position = {name: _position(name, seed) for name in names}
    below = sum(place < fraction for place in position.values())
    count = min(max(1, below), max(0, len(names) - least))
    held_out = set(sorted(names, key=position.__getitem__)[:count])
    train = [name for name in names if name not in held_out]
    return train, [name for name in names if name in held_out]


def _position(name: str, seed: int) -> float:
    """Return a number from 0 to 1 that the name and the seed determine."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8]) / 2**64


def shared_names(splits: Mapping[str, Collection[str]]) -> dict[str, list[str]]:
    """Return the names that two splits share, by pair ("train and val"), without pairs that share nothing."""
    shared = {}
    for first, second in combinations(splits, 2):
        names = set(splits[first]) & set(splits[second])
        if names:
            shared[f"{first} and {second}"] = sorted(names)
    return shared


def overlaps(shared: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a sentence for each pair of `shared_names`."""
    return [f"{len(names)} sequences are in both {pair}: {first_names(names)}" for pair, names in shared.items()]
