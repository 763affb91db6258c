"""Thickness of an object by other views."""

import torch

from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.scene import Views
from completesplat.studies.stage1 import true_thickness
from completesplat.tensors import concatenate

SIZE = 16


def wall(eye_z: float, depth: float) -> Views:
    """One view from `eye_z` along the z axis to z = 2.25: a wall at `depth`, the object in the image's middle."""
    pose = look_at(*(torch.tensor(point) for point in ([[0.0, 0, eye_z]], [[0.0, 0, 2.25]], [[0.0, -1, 0]])))
    cameras = Cameras(pose, pinhole(50, SIZE).float().expand(1, 3, 3), (SIZE, SIZE))
    masks = torch.zeros(1, 1, SIZE, SIZE)
    masks[:, :, 4:-4, 4:-4] = 1
    return Views(torch.zeros(1, 3, SIZE, SIZE), cameras, masks, torch.full((1, 1, SIZE, SIZE), depth))


def test_the_last_surface_is_the_farthest_that_another_view_shows():
    front, back, inside = wall(0, 2.0), wall(6, 3.5), wall(6, 3.75)
    for others in (back, concatenate([back, inside]), concatenate([inside, back])):
        thickness, known = true_thickness(front[0], others)
        torch.testing.assert_close(thickness[known], torch.full_like(thickness[known], 0.5))
        assert 30 < known.sum() <= 64
        assert not known[:4].any()
    assert true_thickness(front[0], inside)[0].max() < 0.26


def test_surfaces_without_depth_or_of_no_object_tell_nothing():
    front, back = wall(0, 2.0)[0], wall(6, 3.5)
    assert not true_thickness(front, wall(6, 0.0))[1].any()
    back.masks.zero_()
    assert not true_thickness(front, back)[1].any()
