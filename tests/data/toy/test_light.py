import json

import numpy as np
import pytest
import torch
from PIL import Image
from support import refused

from completesplat.data.toy import write_objects, write_rooms
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.data.toy.object_scene import render_frame
from completesplat.data.toy.writing import draw_category
from completesplat.errors import DataError

LIGHT = (1.0, 0.75, 0.5)


def test_the_light_colours_what_it_falls_on_and_nothing_else():
    white, lit = (draw_category("toy_minis", 0, 1, 2, np.array(light)) for light in ((1.0, 1.0, 1.0), LIGHT))
    (image, coverage, depth), (other, *geometry) = (render_frame(scene, 1, 24) for scene in (white, lit))
    assert np.array_equal([coverage, depth], geometry)
    np.testing.assert_allclose(other[coverage == 1], image[coverage == 1] * LIGHT)
    assert np.array_equal(other[coverage == 0], image[coverage == 0])  # the dome
    np.testing.assert_allclose(lit.point_colors, white.point_colors * LIGHT)
    ground = draw_category("toy_objects", 0, 1, 2, np.array(LIGHT)), draw_category("toy_objects", 0, 1, 2, np.ones(3))
    lowest, expected = (render_frame(scene, 1, 24)[0][-1] for scene in ground)
    np.testing.assert_allclose(lowest, expected * LIGHT)


def test_rooms_are_lit_too(tmp_path):
    settings = {"scenes": 2, "frames": 2, "size": 16, "seed": 0, "workers": 1, "progress": False}
    folders = [
        write_rooms(tmp_path / name, **settings, light=light) for name, light in (("a", (1, 1, 1)), ("b", LIGHT))
    ]
    images = [sorted(folder.glob("text/*/*/*.jpg")) for folder in folders]
    assert len(images[0]) == 4
    means = [[np.asarray(Image.open(path)).mean((0, 1)) for path in paths] for paths in images]
    np.testing.assert_allclose(means[1], np.array(means[0]) * LIGHT, atol=3)  # JPEG's


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """Root of scenes under another light."""
    root = tmp_path_factory.mktemp("lit")
    write_objects(root, scenes=3, frames=4, size=32, seed=0, workers=1, light=LIGHT, progress=False)
    return root


def test_hidden_modes_are_written_in_the_same_light(lit):
    module = ToyObjectsDataModule(str(lit), image_size=32)
    module.setup("test")
    scene = module.hidden_modes(views=2, spread_views=2)[0]
    assert torch.equal(scene.truths[scene.true_mode], scene.scene.targets.images[0, list(scene.views)])


def test_a_folder_keeps_its_light_and_white_light_is_not_named(lit, toy_root):
    settings = {"scenes": 3, "frames": 4, "size": 32, "seed": 0, "workers": 1, "progress": False}
    assert write_objects(lit, **settings, light=list(LIGHT)) == lit / "toy_objects"
    with pytest.raises(DataError, match="already holds something else"):
        write_objects(lit, **settings)
    assert write_objects(toy_root, **(settings | {"scenes": 4}), light=[1, 1, 1]) == toy_root / "toy_objects"
    assert "light" not in json.loads((toy_root / "toy_objects/toy.json").read_text())


@pytest.mark.parametrize(("light", "reason"), [("[1,1]", "must have 3 entries"), ("[1,-1,1]", "must be at least 0")])
def test_a_light_that_is_no_colour_is_refused(light, reason):
    assert reason in refused("data", "data_task=toy", f"light={light}")
