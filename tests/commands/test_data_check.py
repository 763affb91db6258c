"""`completesplat data check` on a damaged copy: every planted fault is found, and nothing else."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support import strict_json

from completesplat.data.toy import write_objects

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
SET_LIST = "set_lists/set_lists_fewview_train.json"
SCENES = 6


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


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("intact")
    write_objects(root, scenes=SCENES, frames=3, size=16, seed=0, workers=1, progress=False)
    return root


@pytest.fixture
def damaged(intact: Path, tmp_path: Path) -> Path:
    """Copy the intact category, so that a test may damage it."""
    return shutil.copytree(intact, tmp_path / "data/set") / "toy_objects"


def checked(command, root: Path, out: Path, *more: str) -> tuple[Any, Any]:
    settings = ["data=co3d_category", f"data.root={root}", "data.category=toy_objects", "data.subset=fewview_train"]
    finished = command("data", "check", *settings, "data.image_size=16", "workers=1", *more, f"out={out}")
    return finished, strict_json(out / "check.json")


def test_every_planted_fault_is_found_and_nothing_else(command, intact, damaged, tmp_path):
    finished, results = checked(command, intact, tmp_path / "intact")
    assert (finished.status, results["refused"]) == (0, [])
    assert results["usable"] == {"sequences": SCENES, "frames": 3 * SCENES}

    # One fault of each sort: an image, an annotation, a whole sequence, a list. The readers' tests cover the others.
    image, pose, cloud, sound, *_ = sorted(path.name for path in damaged.iterdir() if (path / "images").is_dir())
    cut_short(damaged / image / "images/frame000002.jpg")
    cut_short(damaged / cloud / "pointcloud.ply")
    edit(damaged / SET_LIST, lambda lists: lists["train"].append([sound, 99]))  # frame 99 has no annotation

    def plant(entries: list[dict]) -> None:
        entry = [entry for entry in entries if entry["sequence_name"] == pose][1]
        entry["viewpoint"].update(T=[0.0, float("nan"), 1.0])

    edit(damaged / FRAMES, plant)
    finished, results = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 0
    places = {(entry["sequence"], entry["frame"]) for entry in results["refused"]}
    assert places == {(image, 1), (pose, 1), (cloud, None), (sound, 99)}
    assert len(results["refused"]) == len(places)
    assert all(str(damaged) in entry["file"] and entry["reason"] for entry in results["refused"])
    assert results["usable"] == {"sequences": SCENES - 1, "frames": 3 * (SCENES - 1) - 2}
    assert all(kind in finished.out.replace("\n", " ") and count > 0 for kind, count in results["counts"].items())


@pytest.mark.parametrize(
    ("damage", "count", "file", "reason"),
    [
        (lambda at: [path.write_bytes(b"") for path in at.glob("*/images/*")], 3 * SCENES, "3.jpg", "is empty"),
        (lambda at: cut_short(at / SEQUENCES), 1, SEQUENCES, ""),
    ],
    ids=["no image is usable", "the set cannot be opened"],
)
def test_where_nothing_is_usable_the_status_is_1(command, damaged, tmp_path, damage, count, file, reason):
    damage(damaged)
    finished, results = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 1
    assert results["usable"] == {"sequences": 0, "frames": 0}
    assert len(results["refused"]) == count
    assert results["refused"][-1]["file"].endswith(file)
    assert reason in results["refused"][-1]["reason"]
    assert all(kind in finished.out for kind in results["counts"])


def test_validation_on_test_sequences_is_reported(command, damaged, tmp_path):
    edit(damaged / SET_LIST, lambda lists: lists.update(val=lists["test"]))
    finished, results = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 1
    assert "1 sequences are in both val and test" in results["refused"][-1]["reason"]
    finished, results = checked(command, damaged.parent, tmp_path / "allowed", "data.allow_shared_sequences=true")
    assert (finished.status, list(results["shared"])) == (0, ["val and test"])
    assert len(results["shared"]["val and test"]) == 1
