"""Files of fitted scenes, in the coordinates of the user's photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support import some_gaussians, strict_json

from completesplat.export.fitted_scene import FittedViews, write_fitted_scene
from completesplat.export.placed_scene import FileCoordinates, PlacedScene
from completesplat.export.ply import read_ply
from completesplat.geometry.cameras import Cameras, pinhole

CAMERA = Cameras(torch.eye(4), pinhole(60, 16), (16, 16))


@pytest.mark.parametrize(("far", "offset"), [((300.0, -200.0, 100.0), [0, 0, 0]), ((4e5, 5e6, 300.0), [4e5, 5e6, 300])])
def test_files_have_the_users_coordinates_or_those_less_an_offset_that_scene_json_has(tmp_path, caplog, far, offset):
    places = torch.tensor([[0.25, 0.5, 2.0], [-0.25, 0, 2.0]])
    scene = replace(some_gaussians(1, scale=0.1, opacity=0.9)[0], means=places)
    images = torch.zeros(1, 3, 16, 16)
    placed = PlacedScene(scene, CAMERA, coordinates=FileCoordinates(0.5, far))  # exact in float32
    write_fitted_scene(tmp_path, "a", "a", placed, FittedViews(images, images), 0)
    recorded = strict_json(tmp_path / "scene.json")
    assert recorded["settings"].get("offset", [0, 0, 0]) == offset
    assert caplog.text.count("a: too far from its origin for float32: add offset (400000, 5e+06, 300)") == any(offset)
    stored = read_ply(tmp_path / "scene.ply").means
    user = stored.double().numpy() + offset
    np.testing.assert_allclose(user, 2 * places.double().numpy() + far, rtol=0, atol=1e-12)
    camera = torch.tensor(recorded["reference_camera"]["world_to_camera"])
    torch.testing.assert_close(stored @ camera[:3, :3].T + camera[:3, 3], 2 * places)
