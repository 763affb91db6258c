"""CO3D annotations that must not reach a batch: each is handed on with file, sequence and frame, once, or raised."""

import shutil
from pathlib import Path

import pytest
from bad_annotations import BAD_ENTRIES, BAD_FILES, BAD_FRAMES, CONSEQUENCES, NAN, WITHOUT, drop, put
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SUBSET, change, write_tree

from completesplat.data.co3d.selection import Category, Filters, SeededSplit, read_category
from completesplat.data.validation import BadAnnotation, MissingFile, OutsidePath, UnreadableFile
from completesplat.errors import DataError


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("intact")
    return write_tree(root, dict.fromkeys("abcd", 4), {"train": "ab", "val": "c", "test": "d"})


@pytest.fixture
def category(intact: Path, tmp_path: Path) -> Path:
    """A category whose annotations a test may change."""
    shutil.copytree(intact, tmp_path / "root" / CATEGORY)
    return tmp_path / "root" / CATEGORY


def read(category: Path) -> Category:
    return read_category(category.parent, category.name, SUBSET, SeededSplit(0.1, 0.1, 0), Filters())


def numbers(category: Path, name: str = "a") -> list[int]:
    return [frame.number for frame in read(category).splits["train"].frames[name]]


def test_nothing_is_wrong_with_the_intact_tree(category):
    found = read(category)
    assert found.refused == []
    assert {split: list(members.frames) for split, members in found.splits.items()} == {
        "train": ["a", "b"], "val": ["c"], "test": ["d"],
    }  # fmt: skip


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_bad_frame_is_refused_with_file_sequence_and_frame(name, category):
    edit, kind, part = BAD_FRAMES[name]
    change(category / FRAMES, edit)
    (error,) = read(category).refused
    assert (type(error), error.file, error.sequence, error.frame) == (kind, str(category / FRAMES), "a", 2)
    assert part in error.reason
    assert str(error) == f"{category / FRAMES}, a, frame 2: {error.reason}"
    assert numbers(category) == [0, 1, 3]
    assert numbers(category, "b") == [0, 1, 2, 3]


@pytest.mark.parametrize("name", BAD_ENTRIES)
def test_a_bad_entry_is_refused_with_its_place_and_takes_away_no_more_than_what_it_is_of(name, category):
    file, edit, kind, sequence, frame, part = BAD_ENTRIES[name]
    change(category / file, edit)
    found = read(category)
    first, *others = found.refused
    assert (type(first), first.file, first.sequence, first.frame) == (kind, str(category / file), sequence, frame)
    assert part in first.reason
    assert len(others) == (name in CONSEQUENCES)
    left = {key: [frame.number for frame in frames] for key, frames in found.splits["train"].frames.items()}
    a = [number for number in range(4) if number not in WITHOUT.get(name, [])]
    assert left == {"a": a, "b": [0, 1, 2, 3]} if a else left == {"b": [0, 1, 2, 3]}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_refused_as_a_whole(name, category):
    file, edit, part = BAD_FILES[name]
    change(category / file, edit)
    with pytest.raises(BadAnnotation) as caught:
        read(category)
    assert caught.value.file == str(category / file)
    assert part in caught.value.reason


@pytest.mark.parametrize("file", [FRAMES, SEQUENCES, SET_LIST])
def test_a_truncated_or_missing_file_is_refused_as_a_whole(category, file):
    (category / file).write_bytes((category / file).read_bytes()[:100])
    with pytest.raises(UnreadableFile) as caught:
        read(category)
    assert caught.value.file == str(category / file)
    (category / file).unlink()
    # Without any set list the sequences are split by seed.
    if file != SET_LIST:
        with pytest.raises(MissingFile):
            read(category)


def test_pictures_behind_links_that_leave_the_root_are_refused(category, tmp_path):
    folder = category / "a" / "images"
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    refused = read(category).refused
    assert [(type(error), error.sequence, error.frame) for error in refused] == [
        (OutsidePath, "a", number) for number in range(4)
    ]
    assert all("a link leads outside" in error.reason for error in refused)


@pytest.mark.parametrize("key", ["image", "mask", "depth"])
@pytest.mark.parametrize("path", ["../outside.jpg", "/etc/passwd", f"{CATEGORY}/../../outside.jpg"])
def test_paths_that_lead_outside_are_refused(category, path, key):
    change(category / FRAMES, put(key, "path", value=path))
    (error,) = read(category).refused
    assert type(error) is OutsidePath


@pytest.mark.parametrize("key", ["mass", "timestamp"])
def test_nan_in_a_number_that_nobody_reads_is_no_matter(category, key):
    """Python's `json`, which wrote CO3D, writes NaN."""
    change(category / FRAMES, put("mask", key, value=NAN))
    assert read(category).refused == []
    assert numbers(category) == [0, 1, 2, 3]


def test_a_frame_outside_of_the_set_list_may_be_broken(category):
    change(category / SET_LIST, lambda splits: splits["train"].remove(next(m for m in splits["train"] if m[1] == 2)))
    change(category / FRAMES, put("viewpoint", value=None))
    assert numbers(category) == [0, 1, 3]
    assert read(category).refused == []


def test_a_depth_scale_may_be_a_whole_number_but_no_text(category):
    change(category / FRAMES, put("depth", "scale_adjustment", value=2))
    assert read(category).splits["train"].frames["a"][2].depth.scale_adjustment == 2.0
    for edit in (put("depth", "scale_adjustment", value="2"), drop("depth", "scale_adjustment"), put("depth", value=7)):
        change(category / FRAMES, edit)
        (error,) = read(category).refused
        assert (type(error), error.sequence, error.frame) == (BadAnnotation, "a", 2)
        change(category / FRAMES, put("depth", value={"path": f"{CATEGORY}/x.png", "scale_adjustment": 1.0}))


def test_everything_that_is_broken_is_told_at_once(category):
    change(category / FRAMES, put("viewpoint", value=None))
    change(category / FRAMES, put("mask", value=None, entry=5))
    change(category / SEQUENCES, put("point_cloud", "path", value="../x", entry=2))
    change(category / SET_LIST, lambda splits: splits["test"].append(["d", 7]))
    places: set[tuple[type[DataError], str | None, int | None]] = {
        (type(e), e.sequence, e.frame) for e in read(category).refused
    }
    assert places == {
        (BadAnnotation, "a", 2), (BadAnnotation, "b", 1), (OutsidePath, "c", None), (BadAnnotation, "d", 7),
    }  # fmt: skip
    assert len(read(category).refused) == 4
