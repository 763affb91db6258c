"""Data module of many captures, each of which is one sequence: turntables, or other photos of many objects."""

import logging
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from completesplat.data.captures.captured_frames import Capture
from completesplat.data.captures.module import MODELS, TRANSFORMS, CaptureSource, members, read_captures
from completesplat.data.loading.object_data_module import ObjectDataModule
from completesplat.data.packed.manifest import Scalar
from completesplat.data.splits import FEWEST_SEQUENCES, SPLITS, SeededSplit, split_by_seed
from completesplat.data.validation import field, read_json, require_file
from completesplat.errors import BadAnnotation, DataError, MissingFile, SharedSequences, errors_at
from completesplat.quantities import Natural, Share
from completesplat.wording import SHORT, counted, printable

logger = logging.getLogger(__name__)

SPLITS_FILE = "splits.json"
HOLD_OUT = 8  # one of so many views, where views are held out
MARKS = {"keyframes"}.union(TRANSFORMS, (model.split("/")[0] for model in MODELS))  # a folder with one is a capture


def object_of(name: str) -> str:
    """Return the object that a capture shows: the first folder of its name, whose captures stay in one split."""
    return name.split("/", 1)[0]


def read_splits(path: Path, names: list[str]) -> dict[str, list[str]]:
    """Read a list of splits: {"train": [...], "val": [...], "test": [...]} of captures, or of folders of captures.

    Captures that it does not name belong to no split. Training needs "val".

    Returns:
        The captures of each split, in the order of `names`.

    Raises:
        BadAnnotation: the file holds anything else, or an entry is neither a capture nor a folder of captures.
        SharedSequences: two splits have captures of one object.
    """
    content = read_json(path)
    splits = dict[str, list[str]]()
    owners: dict[str, str] = {}
    with errors_at(path):
        if type(content) is not dict or not content.keys() <= {*SPLITS} or not content:
            keys = printable(", ".join(content), SHORT) if type(content) is dict else printable(repr(content), SHORT)
            raise BadAnnotation(f"must be an object with {', '.join(SPLITS)} alone, not {keys or 'empty'}")
        for split in SPLITS:
            entries = field(content, split, list) if split in content else []
            found = set[str]()
            for entry in entries:
                named = [name for name in names if name == entry or name.startswith(f"{entry}/")]
                if not named:
                    raise BadAnnotation(f"{split} names {repr(entry)[:80]}, which is no capture nor a folder of them")
                found.update(named)
            splits[split] = [name for name in names if name in found]
            for name in splits[split]:
                owner = owners.setdefault(object_of(name), split)
                if owner != split:
                    raise SharedSequences(f"{object_of(name)} is in both {owner} and {split}")
    return splits


class CaptureSetDataModule(ObjectDataModule):
    """Scenes of many captures, where all frames of all captures of an object belong to the same split.

    One or two objects, without a list, cannot be split so. Then every split has all captures, and views of each are
    held out for validation and test (`members`); a warning says so.

    The captures are the folders below `root`, at any depth, that hold one of `MARKS`. A capture's name
    is its path below `root`, and its object is the first folder of that path.

    Args:
        root: folder of the captures, or prepared captures.
        splits: file with the captures of each split (`read_splits`); None: `splits.json` in `root`, or, if it does not
            exist, a seeded split of the objects.
        val_fraction, test_fraction, split_seed: shares of the objects by seed, at least one in each split.
        **settings: of `ObjectDataModule`.
    """

    def __init__(
        self,
        root: str,
        splits: str | None = None,
        val_fraction: Share = 0.05,
        test_fraction: Share = 0.1,
        split_seed: Natural = 0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        self.splits = splits
        self.seeded = SeededSplit(val_fraction, test_fraction, split_seed)

    def describe(self) -> dict[str, str | None]:
        val, test, seed = self.seeded
        split = f"of a list, or by seed {seed}: {val:g} of the objects for validation, {test:g} for the test"
        if self.splits_share_sequences:
            split = f"one of {HOLD_OUT} views of each capture is held out for validation and test"
        return {"data_set": "captures", "split": split, **self.described_views("a capture's first frame")}

    def packed_settings(self) -> dict[str, Scalar]:
        return {"splits": self.splits, **self.seeded._asdict(), **self.framing._asdict()}

    def open(self, split: str) -> Mapping[str, CaptureSource]:
        """Read the cameras of all captures. One that cannot be read is only refused, unless all are."""
        if not self.root.is_dir():
            raise MissingFile("no such folder", str(self.root))
        folders = {folder.relative_to(self.root).as_posix(): folder for folder in _capture_folders(self.root)}
        captures, refused = read_captures(folders)
        if refused and not captures:
            raise refused[0]
        if not captures:
            raise MissingFile("no folders with transforms.json or sparse/0", str(self.root))
        objects = {object_of(name) for name in folders}
        if len(objects) < FEWEST_SEQUENCES and self.seeded.test_fraction < 1 and not self._list().is_file():
            return self._by_views(captures, refused, len(objects))
        sources = {}
        for part, names in self._members(list(folders)).items():
            chosen = {name: captures[name] for name in names if name in captures}
            sources[part] = CaptureSource(chosen, range, self.framing, refused)
        return sources

    def _by_views(
        self, captures: Mapping[str, Capture], refused: list[DataError], objects: int
    ) -> Mapping[str, CaptureSource]:
        """Return all captures for each split, with other views of them for training than for validation and test."""
        self.splits_share_sequences = True
        what = f"{counted(objects, 'object')}, too few for a validation and a test by other objects"
        logger.warning("%s: %s; one of %d views of each capture is held out for both", self.root, what, HOLD_OUT)
        sources = {}
        for part in SPLITS:
            sources[part] = CaptureSource(captures, partial(members, HOLD_OUT, part != "train"), self.framing, refused)
        return sources

    def _list(self) -> Path:
        return self.root / SPLITS_FILE if self.splits is None else require_file(Path(self.splits))

    def _members(self, names: list[str]) -> dict[str, list[str]]:
        listed = self._list()
        if listed.is_file():
            return read_splits(listed, names)
        objects = split_by_seed({object_of(name): [0] for name in names}, self.seeded)
        by_split = {}
        for split in SPLITS:
            by_split[split] = [name for name in names if (object_of(name), 0) in objects[split]]
        return by_split


def _capture_folders(root: Path) -> list[Path]:
    folders: list[Path] = []
    for child in sorted(path for path in root.glob("[!.]*/") if path.is_dir()):  # links are followed here alone
        for folder, below, files in os.walk(child):
            below[:] = sorted(name for name in below if not name.startswith("."))
            if MARKS & {*below, *files}:
                folders.append(Path(folder))
                below.clear()
    return folders
