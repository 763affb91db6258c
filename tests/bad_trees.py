"""Damage to `bad_inputs`' trees other than bad pictures and bad annotations: how it is done, and what is said of it."""

import gzip
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, change, depth_bits, look, orbit, write_cloud
from PIL import Image

from completesplat.data.validation import (
    BadCamera,
    BadPicture,
    BadPlacement,
    MissingFile,
    OutsidePath,
    UnreadableFile,
)
from completesplat.errors import CompleteSplatError, DataError

IMAGE, MASK, DEPTH = (f"a/{part}/frame000002.png" for part in ("images", "masks", "depths"))
CLOUD = "a/pointcloud.ply"
HEAD = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
Damage = Callable[[Path], object]


def gone(file: str) -> Damage:
    return lambda category: (category / file).unlink()


def text(file: str, content: str | bytes) -> Damage:
    return lambda category: (category / file).write_bytes(content if isinstance(content, bytes) else content.encode())


def replaced(file: str, make: Callable[[Path], object]) -> Damage:
    def damage(category: Path) -> None:
        (category / file).unlink()
        make(category / file)

    return damage


def ring(path: Path) -> None:
    path.symlink_to(path.name)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10**12)


def long_name(category: Path) -> None:
    name = f"{CATEGORY}/{'n' * 300}.png"
    change(category / FRAMES, lambda entries: entries[1]["image"].update(path=name))


# name: (damage, kind, file or nothing if it has another name); sequence a, frame 1.
OF_A_FRAME: dict[str, tuple[Damage, type[DataError], str | None]] = {
    "missing_picture": (gone(IMAGE), MissingFile, IMAGE),
    "missing_mask": (gone(MASK), MissingFile, MASK),
    "picture_is_a_folder": (replaced(IMAGE, Path.mkdir), MissingFile, IMAGE),
    "picture_is_a_pipe": (replaced(IMAGE, os.mkfifo), MissingFile, IMAGE),
    "mask_is_a_ring_of_links": (replaced(MASK, ring), MissingFile, MASK),
    "picture_is_a_dead_link": (replaced(IMAGE, lambda path: path.symlink_to("none.png")), MissingFile, IMAGE),
    "picture_of_a_terabyte": (replaced(IMAGE, sparse), BadPicture, IMAGE),
    "picture_is_its_mask's_folder": (replaced(MASK, lambda path: path.symlink_to(".")), MissingFile, MASK),
    "name_too_long": (long_name, MissingFile, None),
}


def cloud(points: np.ndarray) -> Damage:
    return lambda category: write_cloud(category / CLOUD, points)


def without_cloud(damage: Damage, depth_maps: bool = True) -> Damage:
    def both(category: Path) -> None:
        change(category / SEQUENCES, lambda entries: entries[0].update(point_cloud=None))
        if not depth_maps:
            change(category / FRAMES, lambda entries: [{**entry, "depth": None} for entry in entries])
        damage(category)

    return both


def cameras(make: Callable[[np.ndarray, int], dict[str, Any]]) -> Damage:
    """New cameras for sequence a: (eye, number) -> viewpoint."""

    def damage(category: Path) -> None:
        def edit(entries: Any) -> None:
            for number, eye in enumerate(orbit(2)):
                entries[number]["viewpoint"] = make(eye, number)

        change(category / FRAMES, edit)

    return damage


def unknown_depth(category: Path) -> None:
    for number in (1, 2):
        Image.fromarray(depth_bits(np.zeros((24, 32)))).save(category / f"a/depths/frame00000{number}.png")


STANDING = cameras(lambda eye, number: look(np.array([0, 0, 4.0]), np.array([0.1 * number, 0, 0])))
PARALLEL = cameras(lambda eye, number: look(eye, eye + np.array([0, 0, 1])))
AWAY = cameras(lambda eye, number: look(eye, 2 * eye))
# name: (damage, kind, file, frame); sequence a.
OF_A_SEQUENCE: dict[str, tuple[Damage, type[DataError], str | None, int | None]] = {
    "missing_cloud": (gone(CLOUD), MissingFile, CLOUD, None),
    "empty_cloud_file": (text(CLOUD, ""), UnreadableFile, CLOUD, None),
    "garbled_cloud": (text(CLOUD, bytes(range(256))), UnreadableFile, CLOUD, None),
    "cut_cloud": (text(CLOUD, HEAD.format("binary_little_endian", 9) + "x"), UnreadableFile, CLOUD, None),
    "cloud_of_a_huge_header": (text(CLOUD, HEAD.format("ascii", 10**12) + "0 0 0\n"), UnreadableFile, CLOUD, None),
    "cloud_of_a_huge_binary_header": (
        text(CLOUD, HEAD.format("binary_little_endian", 10**12)), UnreadableFile, CLOUD, None,
    ),
    "cloud_of_a_negative_count": (text(CLOUD, HEAD.format("ascii", -3)), UnreadableFile, CLOUD, None),
    "cloud_is_a_folder": (replaced(CLOUD, Path.mkdir), MissingFile, CLOUD, None),
    "cloud_without_points": (cloud(np.zeros((0, 3))), BadPlacement, CLOUD, None),
    "cloud_in_one_place": (cloud(np.ones((5, 3))), BadPlacement, CLOUD, None),
    "cloud_with_nan": (cloud(np.array([[0, 0, 0], [1, np.nan, 0]])), BadPlacement, CLOUD, None),
    "missing_depth_map": (without_cloud(gone(DEPTH)), MissingFile, DEPTH, 1),
    "missing_mask_of_a_depth_map": (without_cloud(gone(MASK)), MissingFile, MASK, 1),
    "no_depth_is_known": (without_cloud(unknown_depth), BadPlacement, None, None),
    "cameras_at_one_place": (STANDING, BadCamera, FRAMES, None),
    "cameras_at_one_place_without_cloud": (without_cloud(STANDING), BadCamera, FRAMES, None),
    "parallel_axes": (without_cloud(PARALLEL, depth_maps=False), BadPlacement, None, None),
    "axes_that_meet_behind": (without_cloud(AWAY, depth_maps=False), BadPlacement, None, None),
}  # fmt: skip


def of_one_frame(category: Path) -> None:
    change(category / SET_LIST, lambda splits: {split: members[::2] for split, members in splits.items()})


def emptied(category: Path) -> None:
    for file in (FRAMES, SEQUENCES):
        change(category / file, lambda entries: [])
    (category / SET_LIST).write_text(json.dumps({"train": [], "val": [], "test": []}))


def outside(category: Path) -> None:
    shutil.copytree(category, category.parent.parent / CATEGORY)


def nested(depth: int) -> bytes:
    return gzip.compress(b"[" * depth + b"]" * depth)


# name: (damage, settings, kind, part of the message): nothing is left to train on.
OF_ALL: dict[str, tuple[Damage, dict[str, Any], type[CompleteSplatError], str]] = {
    "no_such_category": (lambda c: None, {"category": "none"}, DataError, "no such CO3D category"),
    "category_is_a_file": (lambda c: None, {"category": f"{CATEGORY}/{FRAMES}"}, DataError, "no such CO3D category"),
    "category_outside": (outside, {"category": f"../{CATEGORY}"}, OutsidePath, "outside"),
    "no_frame_annotations": (gone(FRAMES), {}, MissingFile, FRAMES),
    "no_sequence_annotations": (gone(SEQUENCES), {}, MissingFile, SEQUENCES),
    "annotations_are_a_folder": (replaced(FRAMES, Path.mkdir), {}, MissingFile, FRAMES),
    "annotations_are_a_ring_of_links": (replaced(FRAMES, ring), {}, MissingFile, FRAMES),
    "empty_annotations": (text(FRAMES, ""), {}, UnreadableFile, FRAMES),
    "annotations_that_are_not_gzipped": (text(FRAMES, "[]"), {}, UnreadableFile, FRAMES),
    "cut_annotations": (lambda c: text(FRAMES, (c / FRAMES).read_bytes()[:-20])(c), {}, UnreadableFile, FRAMES),
    "annotations_of_another_encoding": (
        text(FRAMES, gzip.compress('["é"]'.encode("latin-1"))), {}, UnreadableFile, FRAMES,
    ),
    "gzip_bomb": (text(SEQUENCES, gzip.compress(b"[" + b" " * 2**27 + b"]")), {}, UnreadableFile, "unpacks to more"),
    "deep_nesting": (text(SEQUENCES, nested(10**5)), {}, UnreadableFile, SEQUENCES),
    "set_list_with_nan": (text(SET_LIST, '{"train": [NaN], "val": [], "test": []}'), {}, UnreadableFile, "NaN"),
    "set_list_of_another_subset": (lambda c: None, {"subset": "manyview_test"}, DataError, "fewview_dev"),
    "no_sequences_at_all": (
        emptied,
        {}, DataError, "no train sequences",
    ),
    "sequences_of_one_frame": (of_one_frame, {}, DataError, "no train sequences"),
    "too_few_sequences_to_split": (
        lambda c: change(c / FRAMES, lambda entries: entries[:4]), {"subset": None}, DataError, "cannot be split",
    ),
}  # fmt: skip
