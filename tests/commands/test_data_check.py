"""`completesplat data check` on a damaged copy: every planted fault is found, and nothing else."""

import gzip
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from support import strict_json

from completesplat.data.toy import write_objects

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
SET_LIST = "set_lists/set_lists_fewview_train.json"
SCENES = 26


class Copy:
    """A category that is damaged; each fault has a sequence of its own, and is planted in its frame 1."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = sorted(path.name for path in folder.iterdir() if (path / "images").is_dir())

    def picture(self, name: str) -> Path:
        return self.folder / name / "images/frame000002.jpg"

    def mask(self, name: str) -> Path:
        return self.folder / name / "masks/frame000002.png"

    def cloud(self, name: str) -> Path:
        return self.folder / name / "pointcloud.ply"

    def write(self, name: str, content: bytes) -> None:
        self.picture(name).write_bytes(content)

    def edit(self, file: str, change: Callable[[Any], None]) -> None:
        path = self.folder / file
        packed = path.suffix == ".jgz"
        content = json.loads(gzip.decompress(path.read_bytes()) if packed else path.read_bytes())
        change(content)
        text = json.dumps(content).encode()
        path.write_bytes(gzip.compress(text) if packed else text)

    def frame(self, name: str, change: Callable[[dict], None]) -> None:
        self.edit(FRAMES, lambda entries: change(entry_of(entries, name)))

    def viewpoint(self, name: str, **values: Any) -> None:
        self.frame(name, lambda entry: entry["viewpoint"].update(values))


def entry_of(entries: list[dict], name: str) -> dict:
    return next(entry for entry in entries if (entry["sequence_name"], entry["frame_number"]) == (name, 1))


def encoded(image: Image.Image, form: str, append_images: list[Image.Image] | None = None) -> bytes:
    buffer = io.BytesIO()
    more = {"save_all": True, "append_images": append_images} if append_images else {}
    image.save(buffer, form, **more)
    return buffer.getvalue()


def cut_short(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def link_outside(path: Path) -> None:
    elsewhere = path.parents[5] / "elsewhere.jpg"
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)


def stand_still(copy: Copy, name: str) -> None:
    def edit(entries: list[dict]) -> None:
        members = [entry for entry in entries if entry["sequence_name"] == name]
        for entry in members[1:]:
            entry["viewpoint"] = members[0]["viewpoint"]

    copy.edit(FRAMES, edit)


def spoil_cloud(path: Path) -> None:
    cloud = PlyData.read(str(path), mmap=False)
    cloud["vertex"]["x"][0] = np.nan
    cloud.write(str(path))


grey, red = Image.new("L", (16, 16), 7), Image.new("RGB", (16, 16), (90, 8, 3))
# what is planted: (how, whether the fault is one of frame 1 or of the whole sequence)
FAULTS: dict[str, tuple[Callable[[Copy, str], object], bool]] = {
    "truncated picture": (lambda copy, name: cut_short(copy.picture(name)), True),
    "empty picture": (lambda copy, name: copy.write(name, b""), True),
    "web page as picture": (lambda copy, name: copy.write(name, b"<html>404</html>"), True),
    "picture of another size": (lambda copy, name: copy.write(name, encoded(Image.new("RGB", (16, 17)), "JPEG")), True),
    "missing picture": (lambda copy, name: copy.picture(name).unlink(), True),
    "picture with holes": (lambda copy, name: copy.write(name, encoded(Image.new("RGBA", (16, 16)), "PNG")), True),
    "film as picture": (lambda copy, name: copy.write(name, encoded(grey, "TIFF", append_images=[grey])), True),
    "enormous picture": (lambda copy, name: copy.write(name, encoded(Image.new("1", (9000, 9000)), "PNG")), True),
    "missing mask": (lambda copy, name: copy.mask(name).unlink(), True),
    "truncated mask": (lambda copy, name: cut_short(copy.mask(name)), True),
    "mask in colours": (lambda copy, name: copy.mask(name).write_bytes(encoded(red, "PNG")), True),
    "picture behind a link": (lambda copy, name: link_outside(copy.picture(name)), True),
    "NaN in a pose": (lambda copy, name: copy.viewpoint(name, T=[0.0, float("nan"), 1.0]), True),
    "mirrored pose": (lambda copy, name: copy.viewpoint(name, R=np.diag([1.0, 1.0, -1.0]).tolist()), True),
    "stretched pose": (lambda copy, name: copy.viewpoint(name, R=np.diag([1.0, 1.1, 1.0]).tolist()), True),
    "no focal length": (lambda copy, name: copy.viewpoint(name, focal_length=[0.0, 1.0]), True),
    "principal point outside": (lambda copy, name: copy.viewpoint(name, principal_point=[3.0, 0.0]), True),
    "no viewpoint": (lambda copy, name: copy.frame(name, lambda entry: entry.pop("viewpoint")), True),
    "path to the parent": (lambda copy, name: copy.frame(name, lambda e: e["image"].update(path="../x.jpg")), True),
    "frame twice": (lambda copy, name: copy.edit(FRAMES, lambda all: all.append(entry_of(all, name))), True),
    "listed, not annotated": (lambda copy, name: copy.edit(SET_LIST, lambda s: s["train"].append([name, 99])), True),
    "missing point cloud": (lambda copy, name: copy.cloud(name).unlink(), False),
    "truncated point cloud": (lambda copy, name: cut_short(copy.cloud(name)), False),
    "NaN in a point cloud": (lambda copy, name: spoil_cloud(copy.cloud(name)), False),
    "cameras that stand still": (stand_still, False),
}
# The frame is unusable, but for these: what is there twice is taken once, and frame 99 was never there.
HARMLESS = {"frame twice", "listed, not annotated"}


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("intact")
    write_objects(root, scenes=SCENES, frames=3, size=16, seed=0, progress=False)
    return root


def checked(command, root: Path, out: Path) -> tuple[Any, Any]:
    settings = ["data=co3d_category", f"data.root={root}", "data.category=toy_objects", "data.subset=fewview_train"]
    settings += ["data.image_size=16", "workers=1"]
    finished = command("data", "check", *settings, f"out={out}")
    return finished, strict_json(out / "check.json")


def test_an_intact_set_is_usable_as_a_whole(command, intact, tmp_path):
    finished, found = checked(command, intact, tmp_path / "out")
    assert finished.status == 0
    assert found["usable"] == {"sequences": SCENES, "frames": 3 * SCENES}
    assert found["refused"] == []


def test_every_planted_fault_is_found_and_nothing_else(command, intact, tmp_path):
    assert len(FAULTS) >= 20
    root = tmp_path / "data" / "set"
    shutil.copytree(intact, root)
    copy = Copy(root / "toy_objects")
    planted = dict(zip(copy.names, FAULTS, strict=False))
    for name, fault in planted.items():
        FAULTS[fault][0](copy, name)
    finished, found = checked(command, root, tmp_path / "out")
    assert finished.status == 0
    places = [(entry["sequence"], entry["frame"]) for entry in found["refused"]]
    frames = {fault: 99 if fault == "listed, not annotated" else 1 for fault in FAULTS}
    assert sorted(places, key=str) == sorted(
        [(name, frames[fault] if FAULTS[fault][1] else None) for name, fault in planted.items()], key=str
    )
    for entry in found["refused"]:
        assert str(root) in entry["file"]
        assert entry["reason"]
    lost = sum(FAULTS[fault][1] and fault not in HARMLESS for fault in planted.values())
    whole = sum(not FAULTS[fault][1] for fault in planted.values())
    assert found["usable"] == {"sequences": SCENES - whole, "frames": 3 * (SCENES - whole) - lost}
    for kind, count in found["counts"].items():
        assert kind in finished.out.replace("\n", " ")
        assert count > 0


def empty_pictures(copy: Copy) -> None:
    for picture in copy.folder.glob("*/images/*.jpg"):
        picture.write_bytes(b"")


def share_sequences(copy: Copy) -> None:
    copy.edit(SET_LIST, lambda lists: lists["test"].extend(lists["train"][:6]))


@pytest.mark.parametrize(
    ("damage", "count", "file", "reason"),
    [
        (empty_pictures, 3 * SCENES, "frame000003.jpg", "is empty"),
        (lambda copy: cut_short(copy.folder / SEQUENCES), 1, SEQUENCES, ""),
        (share_sequences, 1, SET_LIST, "2 sequences"),
    ],
    ids=["no picture is usable", "the set cannot be opened", "sequences are trained on and tested"],
)
def test_where_nothing_is_usable_the_status_is_1(command, intact, tmp_path, damage, count, file, reason):
    root = tmp_path / "data/set"
    shutil.copytree(intact, root)
    damage(Copy(root / "toy_objects"))
    finished, found = checked(command, root, tmp_path / "out")
    assert finished.status == 1
    assert found["usable"] == {"sequences": 0, "frames": 0}
    assert len(found["refused"]) == count
    assert found["refused"][-1]["file"].endswith(file)
    assert reason in found["refused"][-1]["reason"]
    assert all(kind in finished.out for kind in found["counts"])
