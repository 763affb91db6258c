"""`completesplat data check` on a damaged copy: every planted fault is found, and nothing else."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from realestate10k_trees import make_clip, write_tree
from support import SMALL, change_json, strict_json

from completesplat.data.toy import write_objects

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
SET_LIST = "set_lists/set_lists_fewview_train.json"
SCENES = 6


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
    change_json(damaged / SET_LIST, lambda lists: lists["train"].append([sound, 99]))  # frame 99 has no annotation

    def plant(entries: list[dict]) -> None:
        entry = [entry for entry in entries if entry["sequence_name"] == pose][1]
        entry["viewpoint"].update(T=[0.0, float("nan"), 1.0])

    change_json(damaged / FRAMES, plant)
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
    change_json(damaged / SET_LIST, lambda lists: lists.update(val=lists["test"]))
    finished, results = checked(command, damaged.parent, tmp_path / "out")
    assert finished.status == 1
    assert "1 sequences are in both val and test" in results["refused"][-1]["reason"]
    finished, results = checked(command, damaged.parent, tmp_path / "allowed", "data.allow_shared_sequences=true")
    assert (finished.status, list(results["shared"])) == (0, ["val and test"])
    assert len(results["shared"]["val and test"]) == 1


def test_clips_without_the_frames_of_an_evaluation_index_are_unusable_and_refused_before_training(command, tmp_path):
    clips = [make_clip(f"c{number}", frames=4) for number in range(3)]
    root = write_tree(tmp_path / "rooms", "text", clips, clips)
    index = {f"c{number}": {"context": [0], "target": [3 if number == 0 else 4]} for number in range(3)}
    (tmp_path / "index.json").write_text(json.dumps(index))
    given = ["data=realestate10k", f"data.root={root}", f"data.evaluation_index={tmp_path / 'index.json'}"]
    command("data", "check", *given, "data.image_size=16", "splits=[test]", "workers=1", "out=CHECK")
    results = strict_json(tmp_path / "CHECK/check.json")
    assert results["usable"] == {"sequences": 1, "frames": 4}
    assert [error["sequence"] for error in results["refused"]] == ["c1", "c2"]
    started = [*given, *SMALL, "data.batch_size=1", "data.val_fraction=0.5", "data.targets=1", "data.max_gap=2"]
    refused = command.refuses("fit", *started, "out=RUN")
    assert "2 of 3 items cannot be read" in refused
    assert "c2, frame 4: the frame is in the evaluation index, not in the data" in refused
    assert not list((tmp_path / "RUN").glob("checkpoints/*"))
