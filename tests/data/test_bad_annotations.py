"""CO3D annotations that must not reach a batch, each refused with a `DataError` that names the file and the entry."""

import gzip
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from completesplat.data.co3d_annotations import object_placement, read_category
from completesplat.errors import DataError

SUBSET = "fewview_train"
FRAMES, SEQUENCES, SET_LIST = "frame_annotations.jgz", "sequence_annotations.jgz", f"set_lists/set_lists_{SUBSET}.json"


@pytest.fixture
def category(toy_root: Path, tmp_path: Path) -> Path:
    """A category whose annotations a test may change."""
    shutil.copytree(toy_root, tmp_path / "copy")
    return tmp_path / "copy" / "toy_objects"


def change(path: Path, edit: Callable[[Any], object]) -> None:
    """`edit` changes the content in place, or returns another one."""
    packed = path.suffix == ".jgz"
    raw = path.read_bytes()
    content = json.loads(gzip.decompress(raw) if packed else raw)
    other = edit(content)
    text = json.dumps(content if other is None else other).encode()
    path.write_bytes(gzip.compress(text) if packed else text)


def put(*keys: str, value: object) -> Callable[[Any], None]:
    """Set a value in the third entry."""

    def edit(entries: Any) -> None:
        entry = entries[2]
        for key in keys[:-1]:
            entry = entry[key]
        entry[keys[-1]] = value

    return edit


def drop(*keys: str) -> Callable[[Any], None]:
    def edit(entries: Any) -> None:
        entry = entries[2]
        for key in keys[:-1]:
            entry = entry[key]
        del entry[keys[-1]]

    return edit


def turned(angle: float, stretch: float = 1.0) -> list[list[float]]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, stretch]]


NAN, INFINITY = float("nan"), float("inf")
CAMERA = "viewpoint"
# name: (change of the third frame's entry, part of the message)
BAD_FRAMES: dict[str, tuple[Callable[[Any], object], str]] = {
    "no_viewpoint": (drop(CAMERA), "no viewpoint"),
    "viewpoint_is_null": (put(CAMERA, value=None), "viewpoint must be of type dict"),
    "viewpoint_is_a_list": (put(CAMERA, value=[1]), "viewpoint must be of type dict"),
    "no_rotation": (drop(CAMERA, "R"), "R must be 3 x 3 numbers"),
    "no_translation": (drop(CAMERA, "T"), "T must be 3 numbers"),
    "no_focal_length": (drop(CAMERA, "focal_length"), "focal_length must be 2 numbers"),
    "no_principal_point": (drop(CAMERA, "principal_point"), "principal_point must be 2 numbers"),
    "rotation_of_strings": (put(CAMERA, "R", value=[["1", "0", "0"]] * 3), "R must be 3 x 3 numbers"),
    "rotation_of_truth_values": (put(CAMERA, "R", value=[[True] * 3] * 3), "R must be 3 x 3 numbers"),
    "rotation_as_nine_numbers": (put(CAMERA, "R", value=[1, 0, 0, 0, 1, 0, 0, 0, 1]), "R must be 3 x 3 numbers"),
    "ragged_rotation": (put(CAMERA, "R", value=[[1, 0, 0], [0, 1], [0, 0, 1]]), "R must be 3 x 3 numbers"),
    "rotation_of_huge_integers": (put(CAMERA, "R", value=[[10**400] * 3] * 3), "R must be 3 x 3 numbers"),
    "stretched_rotation": (put(CAMERA, "R", value=turned(0.3, 1.001)), "R is not orthonormal"),
    "zero_rotation": (put(CAMERA, "R", value=[[0] * 3] * 3), "R is not orthonormal"),
    "reflection": (put(CAMERA, "R", value=turned(0.3, -1.0)), "R is a reflection"),
    "nan_in_rotation": (put(CAMERA, "R", value=turned(0.3, NAN)), "R is not finite"),
    "infinite_translation": (put(CAMERA, "T", value=[0, 0, INFINITY]), "T is not finite"),
    "nan_in_translation": (put(CAMERA, "T", value=[NAN, 0, 1]), "T is not finite"),
    "null_in_translation": (put(CAMERA, "T", value=[None, 0, 1]), "T must be 3 numbers"),
    "four_translations": (put(CAMERA, "T", value=[0, 0, 1, 1]), "T must be 3 numbers"),
    "zero_focal_length": (put(CAMERA, "focal_length", value=[0, 2]), "focal_length must be positive"),
    "negative_focal_length": (put(CAMERA, "focal_length", value=[2, -2]), "focal_length must be positive"),
    "nan_focal_length": (put(CAMERA, "focal_length", value=[NAN, 2]), "focal_length is not finite"),
    "one_focal_length": (put(CAMERA, "focal_length", value=2.0), "focal_length must be 2 numbers"),
    "principal_point_outside": (put(CAMERA, "principal_point", value=[0, 1.2]), "lies outside of the 32 x 32 image"),
    "principal_point_in_pixels": (put(CAMERA, "principal_point", value=[16, 16]), "lies outside"),
    "nan_principal_point": (put(CAMERA, "principal_point", value=[NAN, 0]), "principal_point is not finite"),
    "unknown_intrinsics": (put(CAMERA, "intrinsics_format", value="screen"), "unknown intrinsics format 'screen'"),
    "intrinsics_of_wrong_type": (put(CAMERA, "intrinsics_format", value=[]), "unknown intrinsics format"),
    "no_size": (drop("image", "size"), "no size"),
    "size_of_zero": (put("image", "size", value=[0, 32]), "two positive integers"),
    "negative_size": (put("image", "size", value=[32, -32]), "two positive integers"),
    "fractional_size": (put("image", "size", value=[32.0, 32.0]), "two positive integers"),
    "size_of_three": (put("image", "size", value=[32, 32, 3]), "two positive integers"),
    "size_of_truth_values": (put("image", "size", value=[True, True]), "two positive integers"),
    "size_is_text": (put("image", "size", value="32x32"), "size must be of type list"),
    "no_image": (drop("image"), "no image"),
    "no_mask": (put("mask", value=None), "mask must be of type dict"),
    "path_is_a_number": (put("image", "path", value=7), "path must be of type str"),
    "empty_path": (put("image", "path", value=""), "or nowhere"),
    "path_to_the_parent": (put("image", "path", value="toy_objects/../../x.jpg"), "outside"),
    "absolute_path": (put("mask", "path", value="/etc/passwd"), "outside"),
    "path_with_nul": (put("image", "path", value="toy_objects/a\0.jpg"), "outside"),
    "path_on_a_drive": (put("image", "path", value="C:/x.jpg"), "outside"),
    "path_with_backslashes": (put("mask", "path", value="toy_objects\\..\\x.png"), "outside"),
    "path_is_a_url": (put("image", "path", value="file:///etc/passwd"), "outside"),
    "path_without_an_encoding": (put("image", "path", value="toy_objects/\ud800.jpg"), "no file name has"),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_bad_frame_is_refused_with_file_sequence_and_frame(name, category):
    edit, part = BAD_FRAMES[name]
    change(category / FRAMES, edit)
    with pytest.raises(DataError) as caught:
        read_category(category.parent, category.name, SUBSET)
    assert str(caught.value).startswith(f"{category / FRAMES}: 00000_bear, frame 2: ")
    assert part in str(caught.value)


# name: (file, change, part of the message)
BAD_FILES: dict[str, tuple[str, Callable[[Any], object], str]] = {
    "frames_are_no_list": (FRAMES, lambda entries: {"frames": entries}, "must hold a list"),
    "a_frame_is_null": (FRAMES, lambda entries: [None, *entries], "entry 0: no sequence_name"),
    "a_frame_is_a_list": (FRAMES, lambda entries: [*entries[:2], [1]], "entry 2: no sequence_name"),
    "frame_without_number": (FRAMES, drop("frame_number"), "entry 2: no frame_number"),
    "frame_number_is_text": (FRAMES, put("frame_number", value="2"), "entry 2: frame_number must be of type int"),
    "frame_number_is_a_fraction": (FRAMES, put("frame_number", value=2.5), "entry 2: frame_number must be of type int"),
    "frame_number_is_true": (FRAMES, put("frame_number", value=True), "entry 2: frame_number must be of type int"),
    "sequence_name_is_a_number": (FRAMES, put("sequence_name", value=0), "entry 2: sequence_name must be of type str"),
    "frame_twice": (FRAMES, lambda entries: entries.append(entries[2]), "00000_bear, frame 2 is there twice"),
    "sequences_are_no_list": (SEQUENCES, lambda entries: {"a": 1}, "must hold a list"),
    "sequence_without_name": (SEQUENCES, drop("sequence_name"), "entry 2: no sequence_name"),
    "sequence_twice": (SEQUENCES, lambda entries: entries.append(entries[0]), "sequence 00000_bear is there twice"),
    "cloud_without_path": (SEQUENCES, drop("point_cloud", "path"), "entry 2: no path"),
    "cloud_is_text": (SEQUENCES, put("point_cloud", value="cloud.ply"), "entry 2: no path"),
    "cloud_outside": (SEQUENCES, put("point_cloud", "path", value="../x.ply"), "outside"),
    "set_list_is_a_list": (SET_LIST, lambda splits: [splits], "no train"),
    "set_list_without_test": (SET_LIST, lambda splits: {"train": [], "val": []}, "no test"),
    "split_is_null": (SET_LIST, lambda splits: splits.update(val=None), "val must be of type list"),
    "member_is_short": (SET_LIST, lambda splits: splits["train"].append(["00000_bear"]), "is expected"),
    "member_is_text": (SET_LIST, lambda splits: splits["train"].append("00000_bear"), "is expected"),
    "member_with_number_as_text": (
        SET_LIST,
        lambda splits: splits["val"].append(["00000_bear", "1", "p"]),
        "is expected",
    ),
    "unknown_sequence": (SET_LIST, lambda splits: splits["train"].append(["x", 0, "p"]), "names x, frame 0"),
    "unknown_frame": (
        SET_LIST,
        lambda splits: splits["test"].append(["00000_bear", 99, "p"]),
        "names 00000_bear, frame 99",
    ),
    "listed_sequence_is_not_annotated": (SEQUENCES, lambda entries: entries[1:], "names 00000_bear, frame 0"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_refused_by_name(name, category):
    file, edit, part = BAD_FILES[name]
    change(category / file, edit)
    with pytest.raises(DataError) as caught:
        read_category(category.parent, category.name, SUBSET)
    assert part in str(caught.value)
    assert str(category) in str(caught.value)


def test_pictures_behind_links_that_leave_the_root_are_refused(category, tmp_path):
    folder = category / "00000_bear" / "images"
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match=r"00000_bear, frame 0: a link leads outside"):
        read_category(category.parent, category.name, SUBSET)


@pytest.mark.parametrize("key", ["mass", "timestamp"])
def test_nan_in_a_number_that_nobody_reads_is_no_matter(category, key):
    """Python's `json`, which wrote CO3D, writes NaN."""
    change(category / FRAMES, put("mask", key, value=NAN))
    assert read_category(category.parent, category.name, SUBSET)["train"]


def test_a_frame_outside_of_the_set_list_may_be_broken(category):
    change(category / SET_LIST, lambda splits: splits["train"].remove(next(m for m in splits["train"] if m[1] == 2)))
    change(category / FRAMES, put("viewpoint", value=None))
    sequence = read_category(category.parent, category.name, SUBSET)["train"][0]
    assert [frame.image.name for frame in sequence.frames] == [f"frame{i:06d}.jpg" for i in (1, 2, 4)]


HEAD = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("head", [HEAD.format("ascii", 10**12), HEAD.format("binary_little_endian", 10**12),
                                  HEAD.format("ascii", -3), HEAD.format("ascii", 2).replace(" x", " w"),
                                  HEAD.format("ascii", 2).replace("end_header\n", "")])  # fmt: skip
def test_clouds_with_impossible_headers_are_refused(tmp_path, head):
    (tmp_path / "cloud.ply").write_text(head + "0 0 0\n1 1 1\n")
    with pytest.raises(DataError, match=r"cloud\.ply"):
        object_placement(tmp_path / "cloud.ply")
