"""Scenes in smaller pictures."""

import pytest
import torch

from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.scene import SceneBatch, Views


def views(*axes: int) -> Views:
    cameras = Cameras(torch.eye(4).expand(*axes, 4, 4), pinhole(50.0, 8).expand(*axes, 3, 3), (8, 8))
    images = torch.rand(*axes, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    return Views(images, cameras, torch.ones(*axes, 1, 8, 8))


def test_a_smaller_picture_shows_the_same_from_the_same_camera():
    large = views(2, 3)
    small = large.resized(4)
    assert small.images.shape == (2, 3, 3, 4, 4)
    assert small.images[0, 0, :, 0, 0].tolist() == pytest.approx(large.images[0, 0, :, :2, :2].mean((1, 2)).tolist())
    point = torch.tensor([[0.1, -0.2, 2.0]])
    before, after = (project(v.cameras[0, 0], point)[0] for v in (large, small))
    assert after[0].tolist() == pytest.approx((before[0] / 2).tolist())
    assert small.cameras.image_size == (4, 4)


def test_a_pixel_that_is_partly_hidden_is_hidden():
    visible = torch.ones(1, 1, 8, 8)
    visible[..., 0, 0] = 0
    scenes = SceneBatch(views(1), views(1, 2), torch.ones(1, 2), visible, torch.zeros(1, dtype=torch.int64), ("a",))
    small = scenes.resized(4).visible
    assert (small[0, 0, 0, 0], small.sum()) == (0, 15)
