"""Damaged CO3D trees: each damage is told once with its place, takes no more than it must, and meets the policy."""

import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SIZE, SUBSET, change, depth_bits, write_tree
from PIL import Image

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.co3d.splits import Category, Filters, SeededSplit, read_category
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    BadImage,
    BadPlacement,
    MissingFile,
    OutsidePath,
    UnreadableFile,
)
from completesplat.data.validation.audit import check
from completesplat.errors import DataError

POLICIES = pytest.mark.parametrize("policy", ["raise", "skip"])
NAN = float("nan")
Edit = Callable[[Any], object]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Training sequences a and b, c for validation, d for testing, of four frames each."""
    splits = {"train": "ab", "val": "c", "test": "d"}
    return write_tree(tmp_path_factory.mktemp("intact"), dict.fromkeys("abcd", 4), splits)


@pytest.fixture
def category(intact: Path, tmp_path: Path) -> Path:
    """A category that a test may damage."""
    shutil.copytree(intact, tmp_path / "root" / CATEGORY)
    return tmp_path / "root" / CATEGORY


def read(category: Path) -> Category:
    return read_category(category.parent, category.name, SUBSET, SeededSplit(0.1, 0.1, 0), Filters())


def place(error: DataError) -> tuple[type[DataError], str | None, str | None, int | None]:
    assert "\n" not in str(error)
    return type(error), error.file, error.sequence, error.frame


def put(*keys: str, value: object, entry: int = 2) -> Edit:
    """Set a value in an entry, or remove it (...)."""

    def edit(entries: Any) -> None:
        part = entries[entry]
        for key in keys[:-1]:
            part = part[key]
        if value is ...:
            del part[keys[-1]]
        else:
            part[keys[-1]] = value

    return edit


def turned(angle: float, stretch: float = 1.0) -> list[list[float]]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, stretch]]


CAMERA, SCALE = "viewpoint", ("depth", "scale_adjustment")
R, FOCAL, CENTER = ((CAMERA, key) for key in ("R", "focal_length", "principal_point"))


@pytest.mark.parametrize(
    ("keys", "value", "kind", "part"),
    [
        ((CAMERA,), ..., BadAnnotation, "no viewpoint"),
        (R, ..., BadAnnotation, "R must be 3 x 3 numbers"),
        (R, turned(0.3, 1.001), BadCamera, "R is not orthonormal"),
        (R, turned(0.3, -1.0), BadCamera, "R is a reflection"),
        (R, turned(0.3, NAN), BadAnnotation, "R is not finite"),
        ((CAMERA, "T"), [0.0, 1e200, 4.0], BadAnnotation, "T is not finite in float32"),
        (FOCAL, [0, 2], BadCamera, "focal_length must be positive"),
        (CENTER, [0, 1.2], BadCamera, "lies outside of the 32 x 24 image"),
        ((CAMERA, "intrinsics_format"), "screen", BadAnnotation, "unknown intrinsics format 'screen'"),
        (("image", "size"), [0, 32], BadAnnotation, "two positive integers"),
        (("mask",), None, BadAnnotation, "mask must be of type dict"),
        (SCALE, NAN, BadAnnotation, "scale_adjustment is not finite"),
        (("image", "path"), 7, BadAnnotation, "path must be of type str"),
        (("image", "path"), "things/../../x.jpg", OutsidePath, "outside"),
        (("image", "path"), "things/\ud800.jpg", OutsidePath, "no file name has"),
    ],
)
def test_a_bad_frame_is_refused_with_its_place(category, keys, value, kind, part):
    change(category / FRAMES, put(*keys, value=value))
    result = read(category)
    (error,) = result.refused
    assert place(error) == (kind, str(category / FRAMES), "a", 2)
    assert part in error.reason
    assert str(error) == f"{category / FRAMES}, a, frame 2: {error.reason}"
    left = {name: [frame.number for frame in frames] for name, frames in result.splits["train"].frames.items()}
    assert left == {"a": [0, 1, 3], "b": [0, 1, 2, 3]}


# (file, change, kind, sequence, frame, part of the reason, frames of sequence a that are gone, refusals in all: who an
# entry without a name was of is not known, so that what is missing without it is one more)
BAD_ENTRIES: dict[str, tuple[str, Edit, type[DataError], str | None, int | None, str, list[int], int]] = {
    "null": (FRAMES, lambda e: [None, *e], BadAnnotation, None, None, "entry 0: no sequence_name", [], 1),
    "no_number": (FRAMES, put("frame_number", value=...), BadAnnotation, "a", None, "no frame_number", [2], 1),
    "name_is_a_number": (FRAMES, put("sequence_name", value=0), BadAnnotation, None, None, "entry 2: seq", [2], 2),
    "frame_twice": (FRAMES, lambda e: e.append(e[2]), BadAnnotation, "a", 2, "annotated twice", [], 1),
    "sequence_twice": (SEQUENCES, lambda e: e.append(e[0]), BadAnnotation, "a", None, "annotated twice", [], 1),
    "cloud_outside": (
        SEQUENCES, put("point_cloud", "path", value="../x", entry=0), OutsidePath, "a", None, "outside",
        [0, 1, 2, 3], 1,
    ),
    "quality_is_text": (
        SEQUENCES, put("viewpoint_quality_score", value="1", entry=0), BadAnnotation, "a", None, "must be a number",
        [0, 1, 2, 3], 1,
    ),
    "sequence_not_annotated": (
        SEQUENCES, lambda e: e[1:], BadAnnotation, "a", None, "not annotated", [0, 1, 2, 3], 1,
    ),
    "member_is_short": (SET_LIST, lambda s: s["train"].append(["a"]), BadAnnotation, None, None, "expected", [], 1),
    "unknown_frame": (SET_LIST, lambda s: s["train"].append(["a", 99]), BadAnnotation, "a", 99, "not annotated", [], 1),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_ENTRIES)
def test_a_bad_entry_takes_away_no_more_than_what_it_is_of(name, category):
    file, edit, kind, sequence, frame, part, gone, count = BAD_ENTRIES[name]
    change(category / file, edit)
    result = read(category)
    assert place(result.refused[0]) == (kind, str(category / file), sequence, frame)
    assert part in result.refused[0].reason
    assert len(result.refused) == count
    left = {(name, frame.number) for name, frames in result.splits["train"].frames.items() for frame in frames}
    assert left == {(name, number) for name in "ab" for number in range(4)} - {("a", number) for number in gone}


@POLICIES
@pytest.mark.parametrize(
    ("file", "edit", "part"),
    [
        (FRAMES, lambda entries: {"frames": entries}, "must hold a list"),
        (SET_LIST, lambda splits: [splits], "no train"),
    ],
)
def test_a_file_that_says_nothing_is_raised_under_either_policy(policy, category, file, edit, part):
    change(category / file, edit)
    with pytest.raises(BadAnnotation, match=part) as caught:
        module(category.parent, policy).setup("fit")
    assert caught.value.file == str(category / file)


@pytest.mark.parametrize("file", [FRAMES, SEQUENCES, SET_LIST])
def test_a_truncated_or_missing_file_is_refused_as_a_whole(category, file):
    (category / file).write_bytes((category / file).read_bytes()[:100])
    with pytest.raises(UnreadableFile) as caught:
        read(category)
    assert caught.value.file == str(category / file)
    (category / file).unlink()
    with pytest.raises(MissingFile if file != SET_LIST else DataError):
        read(category)


def test_images_behind_links_that_leave_the_root_are_refused(category, tmp_path):
    folder = category / "a" / "images"
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    refused = read(category).refused
    assert [place(error) for error in refused] == [(OutsidePath, str(category / FRAMES), "a", n) for n in range(4)]
    assert all("leads outside" in error.reason for error in refused)


def test_black_images_and_masks_without_an_object_are_unusable(category):
    black, unmasked = category / "a/images/frame000002.png", category / "b/masks/frame000004.png"
    Image.new("RGB", SIZE[::-1]).save(black)
    Image.new("L", SIZE[::-1]).save(unmasked)
    findings = check(CO3DDataModule(str(category.parent), CATEGORY, image_size=16).open("train"), 1, progress=False)
    expected = [(BadImage, str(black), "a", 1), (BadImage, str(unmasked), "b", 3)]
    assert [place(error) for error in findings.refused] == expected
    assert findings.frames == 16 - 2


def test_what_nobody_reads_may_be_broken(category):
    """NaN in a number that is not used (Python's `json`, which wrote CO3D, writes it); frames that no list names."""
    change(category / FRAMES, put("mask", "mass", value=NAN))
    change(category / FRAMES, put(*SCALE, value=2))
    result = read(category)
    assert result.refused == []
    assert result.splits["train"].frames["a"][2].depth.scale_adjustment == 2.0
    change(category / SET_LIST, lambda splits: splits["train"].remove(next(m for m in splits["train"] if m[1] == 2)))
    change(category / FRAMES, put(CAMERA, value=None))
    result = read(category)
    assert [frame.number for frame in result.splits["train"].frames["a"]] == [0, 1, 3]
    assert result.refused == []


IMAGE, MASK, DEPTH = (f"a/{part}/frame000002.png" for part in ("images", "masks", "depths"))
CLOUD = "a/pointcloud.ply"


def replaced(file: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda category: ((category / file).unlink(), make(category / file))


def without_cloud(damage: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda category: (change(category / SEQUENCES, lambda e: e[0].update(point_cloud=None)), damage(category))


def unknown_depth(category: Path) -> None:
    for number in range(1, 5):
        Image.fromarray(depth_bits(np.zeros((24, 32)))).save(category / f"a/depths/frame00000{number}.png")


# name: (damage, kind, file, frame), of sequence a.
DAMAGES: dict[str, tuple[Callable[[Path], object], type[DataError], str | None, int | None]] = {
    "image_is_text": (lambda category: (category / IMAGE).write_text("image"), BadImage, IMAGE, 1),
    "missing_mask": (lambda category: (category / MASK).unlink(), MissingFile, MASK, 1),
    "image_is_a_pipe": (replaced(IMAGE, os.mkfifo), MissingFile, IMAGE, 1),
    "missing_cloud": (lambda category: (category / CLOUD).unlink(), MissingFile, CLOUD, None),
    "missing_depth_map": (without_cloud(lambda category: (category / DEPTH).unlink()), MissingFile, DEPTH, 1),
    "zero_scale_of_a_depth_map": (
        without_cloud(lambda c: change(c / FRAMES, put(*SCALE, value=0, entry=1))), BadImage, DEPTH, 1,
    ),
    "no_depth_is_known": (without_cloud(unknown_depth), BadPlacement, None, None),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_broken_is_refused_by_the_source_with_its_place(name, category):
    damage, kind, file, frame = DAMAGES[name]
    damage(category)
    source = module(category.parent, "raise").open("train")["train"]
    assert source.refused == []
    (error,) = check({"train": source}, workers=1, progress=False).refused
    assert place(error) == (kind, file and str(category / file), "a", frame)


def module(root: Path, policy: str, **settings: Any) -> CO3DDataModule:
    """Small images, one scene in a batch that shows all frames, and no limit on what is skipped."""
    defaults = {"image_size": 8, "batch_size": 1, "targets": 3, "subset": SUBSET}
    return CO3DDataModule(str(root), CATEGORY, **{**defaults, "on_bad": policy, "max_bad_fraction": 10.0, **settings})


def test_a_partial_download_is_refused_at_once_with_the_setting_that_uses_what_is_there(category):
    for name in "bc":
        shutil.rmtree(category / name)
    given = str(category.parent), CATEGORY
    with pytest.raises(DataError) as caught:
        CO3DDataModule(*given, batch_size=1).setup("fit")
    message = f"{category}: 2 of 4 sequences have no images, as after a partial download; "
    assert str(caught.value) == message + "data.max_bad_fraction=1 uses the others"
    data = CO3DDataModule(*given, batch_size=1, max_bad_fraction=1.0, image_size=16)
    data.setup("test")
    source = data.source("train")
    assert (source.names, source.left_out) == (["a"], {"not downloaded": ["b"]})
    assert [batch.names for batch in data.train_dataloader()] == [("a",)]
    with pytest.raises(DataError, match="2 of 4 sequences have no images"):
        CO3DDataModule(*given, on_bad="raise").source("test")
