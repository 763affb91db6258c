"""CO3D annotations that must not reach a batch: changes of `co3d_trees`' frames, sequences and set list."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from co3d_trees import FRAMES, SEQUENCES, SET_LIST

from completesplat.data.validation import BadAnnotation, BadCamera, OutsidePath
from completesplat.errors import DataError

Edit = Callable[[Any], object]


def put(*keys: str, value: object, entry: int = 2) -> Edit:
    """Set a value in an entry."""

    def edit(entries: Any) -> None:
        place = entries[entry]
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return edit


def drop(*keys: str, entry: int = 2) -> Edit:
    """Remove a value from an entry."""

    def edit(entries: Any) -> None:
        place = entries[entry]
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]

    return edit


def turned(angle: float, stretch: float = 1.0) -> list[list[float]]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, stretch]]


NAN, INFINITY = float("nan"), float("inf")
CAMERA = "viewpoint"
# name: (change of the third entry, which is frame 2 of sequence a; kind; part of the reason)
BAD_FRAMES: dict[str, tuple[Edit, type[DataError], str]] = {
    "no_viewpoint": (drop(CAMERA), BadAnnotation, "no viewpoint"),
    "viewpoint_is_null": (put(CAMERA, value=None), BadAnnotation, "viewpoint must be of type dict"),
    "viewpoint_is_a_list": (put(CAMERA, value=[1]), BadAnnotation, "viewpoint must be of type dict"),
    "no_rotation": (drop(CAMERA, "R"), BadAnnotation, "R must be 3 x 3 numbers"),
    "no_translation": (drop(CAMERA, "T"), BadAnnotation, "T must be 3 numbers"),
    "no_focal_length": (drop(CAMERA, "focal_length"), BadAnnotation, "focal_length must be 2 numbers"),
    "no_principal_point": (drop(CAMERA, "principal_point"), BadAnnotation, "principal_point must be 2 numbers"),
    "rotation_of_strings": (put(CAMERA, "R", value=[["1", "0", "0"]] * 3), BadAnnotation, "R must be 3 x 3 numbers"),
    "rotation_of_truth_values": (put(CAMERA, "R", value=[[True] * 3] * 3), BadAnnotation, "R must be 3 x 3 numbers"),
    "rotation_as_nine_numbers": (
        put(CAMERA, "R", value=[1, 0, 0, 0, 1, 0, 0, 0, 1]),
        BadAnnotation,
        "R must be 3 x 3 numbers",
    ),
    "ragged_rotation": (
        put(CAMERA, "R", value=[[1, 0, 0], [0, 1], [0, 0, 1]]),
        BadAnnotation,
        "R must be 3 x 3 numbers",
    ),
    "rotation_of_huge_integers": (
        put(CAMERA, "R", value=[[10**400] * 3] * 3),
        BadAnnotation,
        "R must be 3 x 3 numbers",
    ),
    "stretched_rotation": (put(CAMERA, "R", value=turned(0.3, 1.001)), BadCamera, "R is not orthonormal"),
    "zero_rotation": (put(CAMERA, "R", value=[[0] * 3] * 3), BadCamera, "R is not orthonormal"),
    "reflection": (put(CAMERA, "R", value=turned(0.3, -1.0)), BadCamera, "R is a reflection"),
    "nan_in_rotation": (put(CAMERA, "R", value=turned(0.3, NAN)), BadAnnotation, "R is not finite"),
    "infinite_translation": (put(CAMERA, "T", value=[0, 0, INFINITY]), BadAnnotation, "T is not finite"),
    "nan_in_translation": (put(CAMERA, "T", value=[NAN, 0, 1]), BadAnnotation, "T is not finite"),
    "null_in_translation": (put(CAMERA, "T", value=[None, 0, 1]), BadAnnotation, "T must be 3 numbers"),
    "four_translations": (put(CAMERA, "T", value=[0, 0, 1, 1]), BadAnnotation, "T must be 3 numbers"),
    "zero_focal_length": (put(CAMERA, "focal_length", value=[0, 2]), BadCamera, "focal_length must be positive"),
    "negative_focal_length": (put(CAMERA, "focal_length", value=[2, -2]), BadCamera, "focal_length must be positive"),
    "nan_focal_length": (put(CAMERA, "focal_length", value=[NAN, 2]), BadAnnotation, "focal_length is not finite"),
    "one_focal_length": (put(CAMERA, "focal_length", value=2.0), BadAnnotation, "focal_length must be 2 numbers"),
    "principal_point_outside": (
        put(CAMERA, "principal_point", value=[0, 1.2]),
        BadCamera,
        "lies outside of the 32 x 24 image",
    ),
    "principal_point_in_pixels": (put(CAMERA, "principal_point", value=[16, 16]), BadCamera, "lies outside"),
    "nan_principal_point": (
        put(CAMERA, "principal_point", value=[NAN, 0]),
        BadAnnotation,
        "principal_point is not finite",
    ),
    "unknown_intrinsics": (
        put(CAMERA, "intrinsics_format", value="screen"),
        BadAnnotation,
        "unknown intrinsics format 'screen'",
    ),
    "intrinsics_of_wrong_type": (
        put(CAMERA, "intrinsics_format", value=[]),
        BadAnnotation,
        "unknown intrinsics format",
    ),
    "no_size": (drop("image", "size"), BadAnnotation, "no size"),
    "size_of_zero": (put("image", "size", value=[0, 32]), BadAnnotation, "two positive integers"),
    "negative_size": (put("image", "size", value=[32, -32]), BadAnnotation, "two positive integers"),
    "fractional_size": (put("image", "size", value=[32.0, 32.0]), BadAnnotation, "two positive integers"),
    "size_of_three": (put("image", "size", value=[32, 32, 3]), BadAnnotation, "two positive integers"),
    "size_of_truth_values": (put("image", "size", value=[True, True]), BadAnnotation, "two positive integers"),
    "size_is_text": (put("image", "size", value="32x32"), BadAnnotation, "size must be of type list"),
    "no_image": (drop("image"), BadAnnotation, "no image"),
    "no_mask": (put("mask", value=None), BadAnnotation, "mask must be of type dict"),
    "nan_depth_scale": (put("depth", "scale_adjustment", value=NAN), BadAnnotation, "scale_adjustment is not finite"),
    "infinite_depth_scale": (
        put("depth", "scale_adjustment", value=INFINITY),
        BadAnnotation,
        "scale_adjustment is not finite",
    ),
    "path_is_a_number": (put("image", "path", value=7), BadAnnotation, "path must be of type str"),
    "empty_path": (put("image", "path", value=""), OutsidePath, "or nowhere"),
    "path_to_the_parent": (put("image", "path", value="things/../../x.jpg"), OutsidePath, "outside"),
    "absolute_path": (put("mask", "path", value="/etc/passwd"), OutsidePath, "outside"),
    "path_with_nul": (put("image", "path", value="things/a\0.jpg"), OutsidePath, "outside"),
    "path_on_a_drive": (put("image", "path", value="C:/x.jpg"), OutsidePath, "outside"),
    "path_with_backslashes": (put("mask", "path", value="things\\..\\x.png"), OutsidePath, "outside"),
    "path_is_a_url": (put("image", "path", value="file:///etc/passwd"), OutsidePath, "outside"),
    "path_without_an_encoding": (put("image", "path", value="things/\ud800.jpg"), OutsidePath, "no file name has"),
}


# name: (file, change, kind, sequence, frame, part of the reason); `train` has a and b, of frames 0 to 3 each.
BAD_ENTRIES: dict[str, tuple[str, Edit, type[DataError], str | None, int | None, str]] = {
    "a_frame_is_null": (FRAMES, lambda e: [None, *e], BadAnnotation, None, None, "entry 0: no sequence_name"),
    "a_frame_is_a_list": (FRAMES, lambda e: [*e, [1]], BadAnnotation, None, None, ": no sequence_name"),
    "frame_without_number": (FRAMES, drop("frame_number"), BadAnnotation, "a", None, "no frame_number"),
    "number_is_text": (FRAMES, put("frame_number", value="2"), BadAnnotation, "a", None, "of type int"),
    "number_is_a_fraction": (FRAMES, put("frame_number", value=2.5), BadAnnotation, "a", None, "of type int"),
    "number_is_true": (FRAMES, put("frame_number", value=True), BadAnnotation, "a", None, "of type int"),
    "name_is_a_number": (FRAMES, put("sequence_name", value=0), BadAnnotation, None, None, "entry 2: seq"),
    "frame_twice": (FRAMES, lambda e: e.append(e[2]), BadAnnotation, "a", 2, "annotated twice"),
    "sequence_is_null": (SEQUENCES, lambda e: [None, *e], BadAnnotation, None, None, "entry 0: no sequence_name"),
    "sequence_without_name": (SEQUENCES, drop("sequence_name", entry=0), BadAnnotation, None, None, "entry 0: no seq"),
    "sequence_twice": (SEQUENCES, lambda e: e.append(e[0]), BadAnnotation, "a", None, "annotated twice"),
    "cloud_without_path": (SEQUENCES, drop("point_cloud", "path", entry=0), BadAnnotation, "a", None, "no path"),
    "cloud_is_text": (SEQUENCES, put("point_cloud", value="x.ply", entry=0), BadAnnotation, "a", None, "no path"),
    "cloud_outside": (SEQUENCES, put("point_cloud", "path", value="../x", entry=0), OutsidePath, "a", None, "outside"),
    "infinite_cloud_quality": (
        SEQUENCES, put("point_cloud", "quality_score", value=INFINITY, entry=0), BadAnnotation, "a", None, "not finite",
    ),
    "quality_is_text": (
        SEQUENCES, put("viewpoint_quality_score", value="1", entry=0), BadAnnotation, "a", None, "must be a number",
    ),
    "member_is_short": (SET_LIST, lambda s: s["train"].append(["a"]), BadAnnotation, None, None, "is expected"),
    "member_is_text": (SET_LIST, lambda s: s["train"].append("a"), BadAnnotation, None, None, "is expected"),
    "member_of_text": (SET_LIST, lambda s: s["val"].append(["c", "1"]), BadAnnotation, None, None, "is expected"),
    "unknown_sequence": (SET_LIST, lambda s: s["train"].append(["x", 0]), BadAnnotation, "x", 0, "but not annotated"),
    "unknown_frame": (SET_LIST, lambda s: s["train"].append(["a", 99]), BadAnnotation, "a", 99, "but not annotated"),
    "sequence_not_annotated": (SEQUENCES, lambda e: e[1:], BadAnnotation, "a", None, "not annotated"),
}  # fmt: skip

# Who an entry without a name was of is not known, so what is missing without it is one more refusal.
CONSEQUENCES = {"name_is_a_number", "sequence_without_name"}
# What else than nothing a bad entry takes away: these frames of sequence a, which are 0 to 3.
WITHOUT: dict[str, Sequence[int]] = {
    "frame_without_number": [2],
    "number_is_text": [2],
    "number_is_a_fraction": [2],
    "number_is_true": [2],
    "name_is_a_number": [2],
    "sequence_without_name": range(4),
    "sequence_not_annotated": range(4),
    "cloud_without_path": range(4),
    "cloud_is_text": range(4),
    "cloud_outside": range(4),
    "infinite_cloud_quality": range(4),
    "quality_is_text": range(4),
}

# Nothing can be used: (file, change, part of the reason).
BAD_FILES: dict[str, tuple[str, Edit, str]] = {
    "frames_are_no_list": (FRAMES, lambda entries: {"frames": entries}, "must hold a list"),
    "sequences_are_no_list": (SEQUENCES, lambda entries: {"a": 1}, "must hold a list"),
    "set_list_is_a_list": (SET_LIST, lambda splits: [splits], "no train"),
    "set_list_without_test": (SET_LIST, lambda splits: {"train": [], "val": []}, "no test"),
    "split_is_null": (SET_LIST, lambda splits: splits.update(val=None), "val must be of type list"),
}
