"""Which frames of a CO3D category belong to which split: set lists, or a split made by seed."""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from completesplat.data.checks import BadAnnotation, Refuse, SharedSequences, at, field, read_json, refused_to
from completesplat.data.sequences import SPLITS
from completesplat.data.splits import split_by_hash
from completesplat.errors import DataError

FEWEST_SEQUENCES = 3
NAMED = 5

Listed = dict[str, set[tuple[str, int]]]
"""(sequence name, frame number) of each split."""

logger = logging.getLogger(__name__)


class SeededSplit(NamedTuple):
    """Shares of the sequences that are held out by seed, at least one sequence each.

    Without a set list, of all sequences; with one that has no validation, `val_fraction` of its training sequences.
    """

    val_fraction: float
    test_fraction: float
    seed: int


def set_list_path(category: Path, subset: str | None) -> Path | None:
    """The set list of that name; None where the sequences are to be split by seed.

    Raises:
        DataError: there is no such set list.
    """
    folder = category / "set_lists"
    if subset is None:
        return None
    there = sorted(path.stem.removeprefix("set_lists_") for path in folder.glob("set_lists_*.json"))
    if not there:
        raise DataError("no set lists there; data.subset=null splits the sequences by seed", str(folder))
    if subset not in there:
        raise DataError(
            f"no set list {subset!r} there; choose data.subset among {', '.join(there)}, or null for a split by seed",
            str(folder),
        )
    return folder / f"set_lists_{subset}.json"


def read_set_list(path: Path, refuse: Refuse) -> Listed:
    """The frames of each split. Entries that are none are handed to `refuse`.

    Raises:
        DataError: the file is missing, unreadable, or has no list for a split.
    """
    content = read_json(path)
    splits: Listed = {}
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


def kept_apart(path: Path, listed: Listed, rule: SeededSplit) -> tuple[Listed, list[str]]:
    """A set list whose training sequences are neither validated nor tested on.

    CO3D's `fewview_train` tests on all that it trains on (facebookresearch/co3d, issue 49); Splatter Image takes
    `fewview_dev` (`data_preprocessing/preprocess_co3d.py`). Validation loses what is in training too. Where it then
    has nothing, a seeded share of the training sequences is its.

    Returns:
        The lists, and the names that validation lost.

    Raises:
        SharedSequences: some sequences are trained on and tested.
    """
    names = {split: {name for name, _ in listed[split]} for split in SPLITS}
    shared = sorted(names["train"] & names["test"])
    if shared:
        said = f"{len(shared)} sequences are trained on and tested: {', '.join(shared[:NAMED])}"
        more = " and others" if len(shared) > NAMED else ""
        advice = "choose another data.subset, or set data.allow_shared_sequences=true"
        raise SharedSequences(f"{said}{more}; {advice}", str(path))
    lost = names["train"] & names["val"]
    train, val = listed["train"], {frame for frame in listed["val"] if frame[0] not in lost}
    if not val and len(names["train"]) > 1:
        held_out = set(split_by_hash(sorted(names["train"]), rule.val_fraction, rule.seed)[1])
        logger.warning(
            "%s lists nothing for validation alone: %d of %d training sequences validate, by seed %d",
            *(path, len(held_out), len(names["train"]), rule.seed),
        )
        val, lost = {frame for frame in train if frame[0] in held_out}, lost - held_out
        train = train - val
    return {"train": train, "val": val, "test": listed["test"]}, sorted(lost)


def split_by_seed(frames: Mapping[str, Iterable[int]], rule: SeededSplit) -> Listed:
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
