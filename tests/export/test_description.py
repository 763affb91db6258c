"""Descriptions of scenes."""

import pytest
import torch
from support import strict_json

from completesplat.export.description import finished_digest, write_scene_json
from completesplat.geometry.cameras import Cameras, pinhole


def test_the_camera_comes_back_exactly_and_numbers_that_are_not_finite_leave_the_old_file(tmp_path):
    oblong, path, settings = Cameras(torch.eye(4), pinhole(50.0, 64), (64, 48)), tmp_path / "s.json", {"steps": 50}
    write_scene_json(path, oblong, settings, 7, {"splat": "größe.ply"})
    with pytest.raises(ValueError, match="JSON"):
        write_scene_json(path, oblong, {"weight": torch.inf}, 0, {})
    scene = strict_json(path)
    stored = scene["reference_camera"]
    assert torch.equal(torch.tensor(stored["world_to_camera"]), oblong.world_to_camera)
    assert torch.equal(torch.tensor(stored["intrinsics"]), oblong.intrinsics)
    assert stored["image_size"] == [64, 48]
    assert (scene["settings"], scene["seed"], scene["files"]) == (settings, 7, {"splat": "größe.ply"})
    assert {"axes", "units", "quaternions", "colors"} <= set(scene["conventions"])
    assert list(tmp_path.iterdir()) == [path]


def test_a_prediction_is_finished_while_all_of_its_files_are_there(tmp_path):
    camera, path = Cameras(torch.eye(4), pinhole(50.0, 8), (8, 8)), tmp_path / "scene.json"
    assert finished_digest(tmp_path) is None
    (tmp_path / "a.ply").touch()
    for files, settings, expected in (
        ({"splat": "a.ply"}, {"made_from": "abc"}, "abc"),
        ({"splat": "a.ply", "video": "b.mp4"}, {"made_from": "abc"}, None),
        ({"splat": "a.ply"}, {}, None),  # a fitted scene
    ):
        write_scene_json(path, camera, settings, 0, files)
        assert finished_digest(tmp_path) == expected
    path.write_text("{")
    assert finished_digest(tmp_path) is None
