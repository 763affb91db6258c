import json

import pytest
import torch

from completesplat.export.prediction import write_scene_json
from completesplat.geometry.cameras import Cameras, pinhole


def camera():
    return Cameras(torch.eye(4), pinhole(50.0, 64), (64, 48))


def strict(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_camera_comes_back_exactly(tmp_path):
    write_scene_json(tmp_path / "s.json", camera(), {"steps": 50, "skip_weight": 0.5}, 7, {"splat": "größe.ply"})
    scene = strict((tmp_path / "s.json").read_text(encoding="utf-8"))
    stored = scene["reference_camera"]
    assert torch.equal(torch.tensor(stored["world_to_camera"]), camera().world_to_camera)
    assert torch.equal(torch.tensor(stored["intrinsics"]), camera().intrinsics)
    assert stored["image_size"] == [64, 48]
    assert scene["settings"] == {"steps": 50, "skip_weight": 0.5}
    assert scene["seed"] == 7
    assert scene["files"] == {"splat": "größe.ply"}
    assert {"axes", "units", "quaternions", "colors"} <= set(scene["conventions"])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_leave_the_old_file(tmp_path, value):
    (tmp_path / "s.json").write_text("{}")
    with pytest.raises(ValueError, match="JSON"):
        write_scene_json(tmp_path / "s.json", camera(), {"weight": value}, 0, {})
    assert (tmp_path / "s.json").read_text() == "{}"
    assert len(list(tmp_path.iterdir())) == 1
