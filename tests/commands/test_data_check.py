"""`completesplat data check` on a damaged copy: every planted fault is found, and nothing else."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import strict_json

from completesplat.data.toy import write_objects

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
SET_LIST = "set_lists/set_lists_fewview_train.json"
PICTURE = "images/frame000002.jpg"
SCENES = 12


def edit(path: Path, change: Callable[[Any], object]) -> None:
    opened = gzip.open if path.suffix == ".jgz" else open
    with opened(path, "rt") as file:
        content = json.load(file)
    change(content)
    with opened(path, "wt") as file:
        json.dump(content, file)


def cut_short(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def link_outside(path: Path) -> None:
    elsewhere = path.parents[5] / "elsewhere.jpg"
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)


# What is done to a sequence's folder and to its frames' annotations; of each sort one, readers' tests have the others.
OF_FRAME_1: dict[str, Callable[[Path, list[dict]], object]] = {
    "truncated picture": lambda folder, frames: cut_short(folder / PICTURE),
    "missing mask": lambda folder, frames: (folder / "masks/frame000002.png").unlink(),
    "picture behind a link": lambda folder, frames: link_outside(folder / PICTURE),
    "path to the parent": lambda folder, frames: frames[1]["image"].update(path="../x.jpg"),
    "NaN in a pose": lambda folder, frames: frames[1]["viewpoint"].update(T=[0.0, float("nan"), 1.0]),
    "mirrored pose": lambda folder, frames: frames[1]["viewpoint"].update(R=np.diag([1.0, 1.0, -1.0]).tolist()),
}
OF_THE_SEQUENCE: dict[str, Callable[[Path, list[dict]], object]] = {
    "truncated point cloud": lambda folder, frames: cut_short(folder / "pointcloud.ply"),
    "cameras that stand still": lambda folder, frames: [f.update(viewpoint=frames[0]["viewpoint"]) for f in frames],
}


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("intact")
    write_objects(root, scenes=SCENES, frames=3, size=16, seed=0, workers=1, progress=False)
    return root


@pytest.fixture
def damaged(intact: Path, tmp_path: Path) -> Path:
    """A category that may be damaged."""
    return shutil.copytree(intact, tmp_path / "data/set") / "toy_objects"


def checked(command, root: Path, out: Path, *more: str) -> tuple[Any, Any]:
    settings = ["data=co3d_category", f"data.root={root}", "data.category=toy_objects", "data.subset=fewview_train"]
    finished = command("data", "check", *settings, "data.image_size=16", "workers=1", *more, f"out={out}")
    return finished, strict_json(out / "check.json")


def test_every_planted_fault_is_found_and_nothing_else(command, intact, damaged, tmp_path):
    finished, found = checked(command, intact, tmp_path / "intact")
    assert (finished.status, found["refused"]) == (0, [])
    assert found["usable"] == {"sequences": SCENES, "frames": 3 * SCENES}

    names = sorted(path.name for path in damaged.iterdir() if (path / "images").is_dir())
    planted = dict(zip(names, [*OF_FRAME_1.values(), *OF_THE_SEQUENCE.values()], strict=False))

    def plant(entries: list[dict]) -> None:
        for name, fault in planted.items():
            fault(damaged / name, [entry for entry in entries if entry["sequence_name"] == name])

    edit(damaged / FRAMES, plant)
    sound = names[len(planted)]
    edit(damaged / SET_LIST, lambda lists: lists["train"].append([sound, 99]))  # which is not annotated
    finished, found = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 0
    whole = len(OF_THE_SEQUENCE)
    frames = [1] * len(OF_FRAME_1) + [None] * whole
    places = [(entry["sequence"], entry["frame"]) for entry in found["refused"]]
    assert sorted(places, key=str) == sorted([*zip(planted, frames, strict=True), (sound, 99)], key=str)
    assert all(str(damaged) in entry["file"] and entry["reason"] for entry in found["refused"])
    left = SCENES - whole
    assert found["usable"] == {"sequences": left, "frames": 3 * left - len(OF_FRAME_1)}
    assert all(kind in finished.out.replace("\n", " ") and count > 0 for kind, count in found["counts"].items())


@pytest.mark.parametrize(
    ("damage", "count", "file", "reason"),
    [
        (lambda at: [path.write_bytes(b"") for path in at.glob("*/images/*")], 3 * SCENES, "3.jpg", "is empty"),
        (lambda at: cut_short(at / SEQUENCES), 1, SEQUENCES, ""),
        (lambda at: edit(at / SET_LIST, lambda of: of["test"].extend(of["train"][:6])), 1, SET_LIST, "2 sequences"),
    ],
    ids=["no picture is usable", "the set cannot be opened", "sequences are trained on and tested"],
)
def test_where_nothing_is_usable_the_status_is_1(command, damaged, tmp_path, damage, count, file, reason):
    damage(damaged)
    finished, found = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 1
    assert found["usable"] == {"sequences": 0, "frames": 0}
    assert len(found["refused"]) == count
    assert found["refused"][-1]["file"].endswith(file)
    assert reason in found["refused"][-1]["reason"]
    assert all(kind in finished.out for kind in found["counts"])


def test_validation_on_test_sequences_is_reported(command, damaged, tmp_path):
    edit(damaged / SET_LIST, lambda lists: lists.update(val=lists["test"]))
    finished, found = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 1
    assert "1 sequences are in both val and test" in found["refused"][-1]["reason"]
    finished, found = checked(command, damaged.parent, tmp_path / "allowed", "data.allow_shared_sequences=true")
    assert (finished.status, list(found["shared"])) == (0, ["val and test"])
    assert len(found["shared"]["val and test"]) == 1
