"""Which frames of a CO3D category belong to which split: set lists, or a split made by seed."""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from completesplat.data.checks import BadAnnotation, Refuse, at, field, read_json, refused_to
from completesplat.data.sequences import SPLITS
from completesplat.data.splits import split_by_hash
from completesplat.errors import DataError

FEWEST_SEQUENCES = 3

logger = logging.getLogger(__name__)


class SeededSplit(NamedTuple):
    """Shares of the sequences that are held out where there are no set lists, at least one sequence each."""

    val_fraction: float
    test_fraction: float
    seed: int


def set_list_path(category: Path, subset: str | None) -> Path | None:
    """The set list of that name; None where the sequences are to be split by seed.

    Raises:
        DataError: there are set lists, but not this one.
    """
    folder = category / "set_lists"
    if subset is None:
        return None
    there = sorted(path.stem.removeprefix("set_lists_") for path in folder.glob("set_lists_*.json"))
    if not there:
        logger.warning("%s has no set lists: its sequences are split by seed", category)
        return None
    if subset not in there:
        raise DataError(
            f"no set list {subset!r} there; choose data.subset among {', '.join(there)}, or null for a split by seed",
            str(folder),
        )
    return folder / f"set_lists_{subset}.json"


def read_set_list(path: Path, refuse: Refuse) -> dict[str, set[tuple[str, int]]]:
    """(sequence name, frame number) of each split. Entries that are none are handed to `refuse`.

    Raises:
        DataError: the file is missing, unreadable, or has no list for a split.
    """
    content = read_json(path)
    splits: dict[str, set[tuple[str, int]]] = {}
    for split in SPLITS:
        with at(path):
            members = field(content, split, list)
        splits[split] = set()
        for member in members:
            with refused_to(refuse), at(path):
                if type(member) is not list or [type(part) for part in member[:2]] != [str, int]:
                    raise BadAnnotation(
                        f"{split} has {str(member)[:80]} where [sequence name, frame number, path] is expected"
                    )
                splits[split].add((member[0], member[1]))
    return splits


def split_by_seed(frames: Mapping[str, Iterable[int]], rule: SeededSplit) -> dict[str, set[tuple[str, int]]]:
    """Whole sequences for each split.

    Raises:
        DataError: fewer than three sequences.
    """
    if len(frames) < FEWEST_SEQUENCES:
        raise DataError(f"{len(frames)} sequences cannot be split into train, val and test; write a set list")
    rest, test = split_by_hash(sorted(frames), rule.test_fraction, rule.seed)
    # The rest's hashes lie above the test fraction, so the next share of them is validation's.
    train, val = split_by_hash(rest, rule.test_fraction + rule.val_fraction, rule.seed)
    if not train:
        raise DataError(
            f"no training sequences with val_fraction={rule.val_fraction}, test_fraction={rule.test_fraction}"
        )
    names = {"train": train, "val": val, "test": test}
    return {split: {(name, number) for name in names[split] for number in frames[name]} for split in SPLITS}
