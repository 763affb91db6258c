"""Data sets of many captures: which captures belong to which split."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from packed_sequences import prepared
from support import write_capture

from completesplat.data.captures.capture_set import CaptureSetDataModule
from completesplat.data.captures.module import CaptureDataModule
from completesplat.errors import BadAnnotation, DataError, MissingFile, SharedSequences

OBJECTS, RINGS = ("apple", "cherry", "pear", "plum"), ("r0", "r1")
NAMES = [f"{fruit}/{ring}" for fruit in OBJECTS for ring in RINGS]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in NAMES:
        folder = tmp_path / "fruits" / name
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_capture(folder, 6)
    return tmp_path / "fruits"


def module(root: Path, **settings: Any) -> CaptureSetDataModule:
    return CaptureSetDataModule(str(root), image_size=16, batch_size=1, targets=2, **settings)


def split(data: CaptureSetDataModule) -> dict[str, list[str]]:
    return {part: source.names for part, source in data.open("train").items()}


def test_one_object_is_split_by_views_which_is_said(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    for fruit in OBJECTS[1:]:
        shutil.rmtree(root / fruit)
    data = module(root)
    train, val = data.source("train"), data.source("val")
    assert train.names == val.names == data.source("test").names == ["apple/r0", "apple/r1"]
    seen, held_out = (set(source.read("apple/r0").frames) for source in (train, val))
    assert len(held_out) == 3
    assert sorted(seen | held_out) == list(range(6))
    assert not seen & held_out
    assert "1 object, too few for a validation and a test by other objects" in caplog.text
    assert data.describe()["split"] == "one of 8 views of each capture is held out for validation and test"
    (root / "splits.json").write_text(json.dumps({"train": ["apple"]}))
    assert split(module(root)) == {"train": ["apple/r0", "apple/r1"], "val": [], "test": []}


@pytest.mark.parametrize("seed", range(4))
def test_a_seeded_split_keeps_the_captures_of_an_object_together(root: Path, seed: int) -> None:
    parts = split(module(root, val_fraction=0.25, test_fraction=0.25, split_seed=seed))
    assert sorted(name for names in parts.values() for name in names) == NAMES
    assert all(parts.values())
    owners = [{name.split("/")[0] for name in names} for names in parts.values()]
    assert sum(map(len, owners)) == len(OBJECTS)


def test_a_list_names_captures_or_folders_of_them_and_leaves_the_others_out(root: Path) -> None:
    listed = {"train": ["apple", "cherry/r1"], "test": ["pear/r0"]}
    (root / "splits.json").write_text(json.dumps(listed))
    expected = {"train": ["apple/r0", "apple/r1", "cherry/r1"], "val": [], "test": ["pear/r0"]}
    assert split(module(root)) == expected
    other = root.parent / "other.json"
    other.write_text(json.dumps({"test": ["plum"]}))
    assert split(module(root, splits=str(other)))["test"] == ["plum/r0", "plum/r1"]


@pytest.mark.parametrize(
    ("listed", "error", "message"),
    [
        ({"train": ["fig"]}, BadAnnotation, "train names 'fig'"),
        ({"train": ["app"]}, BadAnnotation, "train names 'app'"),
        ({"train": [7]}, BadAnnotation, "train names 7"),
        ({"train": ["apple/r0"], "test": ["apple/r1"]}, SharedSequences, "apple is in both train and test"),
        ({"train": "apple"}, BadAnnotation, "must be of type list"),
    ],
)
def test_a_list_that_names_unknown_captures_or_shares_an_object_is_refused(
    root: Path, listed: dict[str, Any], error: type[DataError], message: str
) -> None:
    (root / "splits.json").write_text(json.dumps(listed))
    with pytest.raises(error, match=message) as caught:
        split(module(root))
    assert caught.value.file == str(root / "splits.json")


def test_a_damaged_capture_is_refused_and_the_others_are_used(root: Path) -> None:
    (root / "apple/r0/transforms.json").write_text("{")
    sources = module(root, test_fraction=1.0).open("test")
    assert sources["test"].names == NAMES[1:]
    assert [error.sequence for error in sources["test"].refused] == ["apple/r0"]


def test_a_folder_without_captures_or_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"no folders with transforms\.json"):
        module(tmp_path).open("train")
    with pytest.raises(MissingFile, match="no such folder"):
        module(tmp_path / "nowhere").open("train")


def test_packed_captures_are_the_same_data_set(root: Path, tmp_path: Path) -> None:
    data = module(root, val_fraction=0.25, test_fraction=0.25)
    packed = module(prepared(data, tmp_path / "store", codec="png"), val_fraction=0.25, test_fraction=0.25)
    for part, names in split(data).items():
        assert sorted(packed.source(part).names) == names
        sequence = packed.source(part).read(names[0])
        assert (sequence.read(3).image == data.source(part).read(names[0]).read(3).image).all()


def test_a_list_may_name_a_capture_that_cannot_be_read(root: Path) -> None:
    (root / "splits.json").write_text(json.dumps({"train": ["apple/r0", "apple/r1", "cherry"], "val": ["pear"]}))
    (root / "apple/r1/transforms.json").write_text("{}")
    assert split(module(root))["train"] == ["apple/r0", "cherry/r0", "cherry/r1"]


def test_captures_are_those_of_data_capture_and_linked_ones_but_no_hidden_ones(root: Path) -> None:
    (root / "apple/r0/transforms.json").rename(root / "apple/r0/transforms_train.json")
    (root / "cherry").rename(root.parent / "elsewhere")
    for name in ("cherry", "again"):
        (root / name).symlink_to(root.parent / "elsewhere/r0")
    (root / "pear").rename(root / ".turntable.unfinished")
    expected = ["again", "apple/r0", "apple/r1", "cherry", "plum/r0", "plum/r1"]
    assert sorted(name for names in split(module(root)).values() for name in names) == expected
    assert CaptureDataModule(str(root)).open("test")["test"].names == ["again", "cherry"]
