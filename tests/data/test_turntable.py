"""Turntables: cameras against those that toy objects were drawn with, what photos say about a turn, what is refused."""

import json
import logging
import re
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from support import refused
from turntables import SIZE, draw, toy, write_turn

from completesplat.data.captures import turntable
from completesplat.data.captures.capture_set import CaptureSetDataModule
from completesplat.data.captures.module import read_capture
from completesplat.data.captures.turn_checks import hull_overlap
from completesplat.data.toy.shapes import rotation_about
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, look_at

DEFAULTS = {"photos_of_a_turn": None, "elevation": 0, "fov": 18, "direction": None, "height": "ring"}
DEFAULTS |= {"background": "white", "splits": None}


def angles_to(folder: Path, azimuths: np.ndarray) -> np.ndarray:
    """Angles in degrees between the cameras and those that the photos were drawn with, both seen from their first."""
    frames = read_capture(folder).frames
    rotations = np.stack([frame.world_to_camera[:3, :3] for frame in frames])
    true = np.stack([np.diag([1, -1, -1]) @ rotation_about("y", azimuth).T for azimuth in azimuths])
    difference = Rotation.from_matrix(rotations @ rotations[0].T) * Rotation.from_matrix(true @ true[0].T).inv()
    return np.degrees(difference.magnitude())


def import_turns(folder: Path, out: Path, **settings: object) -> Path:
    out.mkdir(exist_ok=True)
    turntable.import_turntables(folder, out, DEFAULTS | settings)
    return out


def reason(folder: Path, out: Path, **settings: object) -> str:
    """The line that refuses an import, which leaves nothing behind."""
    with pytest.raises(DataError) as caught:
        import_turns(folder, out, **settings)
    assert not list(out.iterdir())
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(folder), "TURNS")


AZIMUTHS = 2 * np.pi * np.arange(12) / 12


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """Two turns of 12 photos, in opposite directions: `a/left` and `b/right`."""
    folder = tmp_path_factory.mktemp("turns")
    write_turn(folder / "a/left", AZIMUTHS)
    write_turn(folder / "b/right", -AZIMUTHS)
    return folder


@pytest.fixture
def turns(drawn, tmp_path) -> Path:
    return shutil.copytree(drawn, tmp_path / "turns")


def test_cameras_are_those_that_cropped_toys_were_drawn_with_in_both_directions(turns, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    out = import_turns(turns, tmp_path / "out")
    assert angles_to(out / "a/left", AZIMUTHS).max() < 0.2
    assert angles_to(out / "b/right", -AZIMUTHS).max() < 0.2
    assert "2 turns; flow in the middle goes left in 1, right in 1, is unclear in 0;" in caplog.text
    assert "flow goes right, unlike in most: b/right" in caplog.text
    assert float(re.search(r"overlap by ([0-9.]+) with their visual hull", caplog.text)[1]) >= 0.95
    assert Image.open(out / "sheet.png").width >= 8 * 48
    capture = read_capture(out / "a/left")
    for frame in capture.frames:  # each mask is as high as the others, in the middle of its square
        left, top, right, bottom = frame.read()[1].point(lambda value: 255 * (value > 127)).getbbox()
        size = frame.lens.image_size[0]
        assert abs((left + right) - size) <= 2
        assert abs((top + bottom) - size) <= 2
    shown = import_turns(turns, tmp_path / "given", direction=1)
    assert angles_to(shown / "b/right", AZIMUTHS).max() < 0.2


def test_photos_of_one_camera_keep_their_scale_and_the_elevation_is_that_given(tmp_path):
    write_turn(tmp_path / "turns", AZIMUTHS, crop=False)
    out = import_turns(tmp_path / "turns", tmp_path / "out", height=None, fov=20, elevation=30)
    frames = read_capture(out / "turns").frames
    assert frames[0].lens.focal == pytest.approx((SIZE / 2 / np.tan(np.radians(10)),) * 2)
    for index, frame in enumerate(frames):
        number = np.asarray(frame.read()[1], float).sum() / 255
        drawn = (np.asarray(Image.open(tmp_path / f"turns/photo {index}.png")).min(-1) < 245).sum()
        assert number == pytest.approx(drawn, abs=1)
        eye = np.linalg.inv(frame.world_to_camera)[:3, 3]
        assert eye[2] / np.linalg.norm(eye) == pytest.approx(0.5)
        assert frame.world_to_camera[2, :3] @ eye == pytest.approx(-np.linalg.norm(eye))  # it looks at the origin


def test_numbers_in_file_names_are_positions_in_the_turn(turns, tmp_path):
    kept = [0, 1, 2, 3, 5, 6, 7, 8, 9, 11]
    for index in kept:  # the third in the next turn
        (turns / f"a/left/photo {index}.png").rename(turns / f"a/left/1_{10 * index + 120 * (index == 2)}.png")
    for photo in (turns / "a/left").glob("photo *"):
        photo.unlink()
    (tmp_path / "turns.json").write_text(json.dumps({"a/left": 120, "b/right": 12}))
    out = import_turns(turns, tmp_path / "out", photos_of_a_turn=str(tmp_path / "turns.json"))
    assert angles_to(out / "a/left", AZIMUTHS[kept]).max() < 0.2
    assert angles_to(out / "b/right", -AZIMUTHS).max() < 0.2


def test_what_is_no_turn_is_one_line(turns, tmp_path):
    out, first = tmp_path / "out", turns / "a/left"
    assert reason(turns, out, splits="no.json") == "no.json: no such file"
    for content, message in (
        ({"train": ["a"], "test": ["a/rihgt"]}, "test names 'a/rihgt', which is no capture nor a folder of them"),
        ({"train": ["a/left"], "val": ["a"]}, "a is in both train and val"),
    ):
        (tmp_path / "splits.json").write_text(json.dumps(content))
        assert message in reason(turns, out, splits=str(tmp_path / "splits.json"))
    assert reason(tmp_path / "typo", out) == "TURNS: no such folder"
    one = tmp_path / "one"
    one.mkdir()
    assert reason(one, out) == "TURNS: no photos there, nor in its folders"
    shutil.copy(first / "photo 0.png", one / "a.png")
    assert reason(one, out) == "one: 1 photo; a turn needs at least 8"
    for index in range(7):
        shutil.copy(first / "photo 0.png", one / f"b{index}.png")
    for count in (0, -3):
        (tmp_path / "turns.json").write_text(json.dumps({"one": count}))
        few = f"photos_of_a_turn: {count}; a turn needs at least 8"
        assert few in reason(one, out, photos_of_a_turn=str(tmp_path / "turns.json"))
    unnumbered = "TURNS/a.png, one: no number in this name, but photos_of_a_turn needs"
    assert unnumbered in reason(one, out, photos_of_a_turn=8)
    shutil.copy(first / "photo 0.png", one / "b8.png")
    (one / "a.png").unlink()
    assert "b8.png, one: the same position in the turn of 8 photos as b0.png" in reason(one, out, photos_of_a_turn=8)
    Image.new("RGB", (SIZE, 40), "white").save(one / "b8.png")
    assert "its mask is empty" in reason(one, out)
    assert "background=null: its mask fills the photo; another background (white, remove)" in reason(
        one, out, background=None
    )
    draw(toy(), 0).crop((0, 0, SIZE, 40)).save(one / "b8.png")
    assert reason(one, out) == "one: photos of several sizes: 48 x 40, 48 x 48"
    Image.new("RGB", (SIZE, SIZE), "grey").save(one / "b0.png")
    assert "TURNS/b0.png, one: background=white: its mask fills the photo" in reason(one, out)


def test_a_turn_that_does_not_close_is_named_and_left_out_of_the_splits_too(turns, tmp_path, caplog):
    for index in range(12):
        draw(toy(), np.pi * index / 12).save(turns / f"a/left/photo {index}.png")  # half a turn
    (tmp_path / "splits.json").write_text(json.dumps({"train": ["b"], "test": ["a"]}))
    out = import_turns(turns, tmp_path / "out", splits=str(tmp_path / "splits.json"))
    assert "left out: a/left: the turn does not close: last and first photo differ by" in caplog.text
    assert sorted(path.name for path in out.iterdir()) == ["b", "sheet.png", "splits.json"]
    data = CaptureSetDataModule(str(out), image_size=32)
    names = [source.names for source in data.open("train").values()]
    assert names == [["b/right"], [], []]  # train, val, test
    with pytest.raises(DataError, match="b/right: exists already: choose another out=DIR"):
        import_turns(turns, out)


def test_an_interrupted_import_leaves_nothing_and_can_be_repeated(turns, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(turntable, "_write_transforms", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            import_turns(turns, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_dir()]
    killed = tmp_path / "out/.turntable.unfinished/a/left/images"  # by a signal that no process can catch
    killed.mkdir(parents=True)
    out = import_turns(turns, tmp_path / "out")
    assert sorted(path.name for path in out.iterdir()) == ["a", "b", "sheet.png"]
    (turns / "a").rename(turns / "c")
    shutil.rmtree(turns / "b")
    with pytest.raises(DataError, match=r"sheet\.png: exists already: choose another out=DIR"):
        import_turns(turns, out)


def test_the_object_is_what_transparency_or_the_remover_says_or_what_white_does_not_reach(rembg, tmp_path):
    ring = Image.new("RGBA", (16, 16), (255, 255, 255, 0))
    ring.paste((0, 0, 255, 255), (3, 3, 13, 13))
    ring.paste((255, 255, 255, 255), (6, 6, 9, 9))  # white within the object, which no white way leads to
    ring.save(tmp_path / "a.png")
    expected = np.zeros((16, 16), np.uint8)
    expected[3:13, 3:13] = 255
    for background in (None, "white"):
        image, mask = turntable._read_photo(tmp_path / "a.png", background)
        np.testing.assert_array_equal(np.asarray(mask), expected)
        np.testing.assert_array_equal(np.asarray(image), np.asarray(ring.convert("RGB")))
    photo = Image.new("RGB", (16, 16), "red")
    photo.paste("blue", (3, 3, 13, 13))
    photo.save(tmp_path / "b.png")
    image, mask = turntable._read_photo(tmp_path / "b.png", "remove")
    np.testing.assert_array_equal(np.asarray(mask), expected)
    assert image.getpixel((0, 0)) == (255, 255, 255)


def test_the_hull_of_a_ball_fits_its_masks_and_that_of_shifted_masks_does_not():
    x, y = np.meshgrid(*[np.arange(64) + 0.5 - 32] * 2)
    disc = (x**2 + y**2 < 28**2).astype(np.float32)
    masks = torch.from_numpy(np.stack([disc] * 12)[:, None])
    angles = torch.arange(12, dtype=torch.float64) * torch.pi / 6
    eyes = 20 * torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=-1)
    intrinsics = torch.tensor([[640, 0, 32], [0, 640, 32], [0, 0, 1]], dtype=torch.float64).expand(12, 3, 3)
    cameras = Cameras(look_at(eyes, 0 * eyes, eyes.new_tensor([0, 0, 1])), intrinsics, (64, 64))
    assert hull_overlap(masks, cameras) > 0.97
    shifted = masks.clone()
    shifted[::2] = masks[::2].roll(8, -1)
    assert hull_overlap(shifted, cameras) < 0.8


def test_settings_that_no_turntable_has_are_refused_before_any_work():
    for setting, message in (("direction=2", "1, -1"), ("fov=0", "between 1 and 120"), ("background=black", "white")):
        assert message in refused("data", "data_task=import", "folder=x", "cameras=turntable", setting)
