import json
from itertools import product

import numpy as np
import pytest
import torch

from completesplat.data.captures import import_capture
from completesplat.data.captures.capture import Lens
from completesplat.data.captures.layout import Undistortion, _source_positions, held_out_frames


def test_every_eighth_frame_is_held_out_and_two_at_least_are_on_either_side():
    assert sorted(held_out_frames(40, 8)) == [0, 8, 16, 24, 32]
    for frames, hold_out in product(range(6, 40), (2, 3, 8, 1000)):
        held_out = held_out_frames(frames, hold_out)
        assert held_out <= set(range(frames))
        assert min(len(held_out), frames - len(held_out)) >= 2


def test_frames_stand_in_the_order_of_their_numbers_and_none_that_is_tested_is_trained_on(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    (tmp_path / "in/images/r_3.png").rename(tmp_path / "in/images/r_10.png")
    captures.edit(path, lambda c: (c["frames"][3].update(file_path="images/r_10.png"), c["frames"].reverse()))
    category = import_capture(tmp_path / "out", "desk", path, hold_out=3, progress=False)
    entries = captures.annotations(category)
    names = [f"r_{number}.png" for number in (0, 1, 2, 4, 5, 6, 7, 10)]
    assert [entry["meta"]["imported_from"] for entry in entries] == names
    lists = json.loads((category / "set_lists/set_lists_imported.json").read_text())
    numbers = {split: [entry[1] for entry in entries] for split, entries in lists.items()}
    assert numbers == {"train": [1, 2, 4, 5, 7], "val": [0, 3, 6], "test": [0, 3, 6]}
    written = {entry["frame_number"]: entry["image"]["path"] for entry in entries}
    assert all(written[number] == path for entries in lists.values() for _, number, path in entries)


def test_the_lens_model_is_colmaps():
    pycolmap = pytest.importorskip("pycolmap")
    lens = Lens((190.0, 205.0), (112.5, 66.0), (150, 210), (-0.18, 0.04, 0.002, -0.003, 0.0))
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 1.0, 210, 150)
    camera.params = [*lens.focal, *lens.center, *lens.distortion[:4]]
    x, y = np.meshgrid(np.arange(210) + 0.5, np.arange(150) + 0.5)
    rays = np.stack([(x - 112.5) / 190, (y - 66) / 205, np.ones_like(x)], axis=-1)
    expected = camera.img_from_cam(rays.reshape(-1, 3)).reshape(150, 210, 2)
    torch.testing.assert_close(_source_positions(lens), torch.from_numpy(expected).float(), atol=1e-4, rtol=0)


def test_a_barrel_keeps_its_size_and_a_pincushion_its_focal_lengths():
    barrel = Lens((190.0, 205.0), (112.5, 66.0), (150, 210), (-0.1, 0.0, 0.0, 0.0, 0.0))
    assert Undistortion(barrel).pinhole == Lens(barrel.focal, barrel.center, barrel.image_size)
    pincushion = Lens((190.0, 205.0), (112.5, 66.0), (150, 210), (0.1, 0.0, 0.0, 0.0, 0.0))
    cropped = Undistortion(pincushion).pinhole
    assert cropped.focal == pincushion.focal
    assert all(120 < after < before for after, before in zip(cropped.image_size, (150, 210), strict=True))


def test_a_fold_within_the_picture_is_cut_off():
    # x (1 - x^2 / 3) turns at x = 1, which lies 95 pixels from the centre: within the picture, in its corners.
    lens = Lens((95.0, 95.0), (80.0, 80.0), (160, 160), (-1 / 3, 0.0, 0.0, 0.0, 0.0))
    pinhole = Undistortion(lens).pinhole
    corner = np.hypot(*(np.array(pinhole.image_size) / 2 - 0.5))
    assert 91 < corner <= 95
