"""Measures of samples in closed form, and the figures of the studies."""

import math

import imageio.v3 as imageio
import pytest
import torch

from completesplat.evaluation.studies.controls import PAPER, grid, plot_controls
from completesplat.evaluation.studies.samples import near_reference, object_psnr
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.metrics.images import PSNR_LIMIT, psnr


def test_object_pixels_alone_count():
    true, masks = torch.rand(2, 3, 4, 4), torch.zeros(2, 1, 4, 4)
    masks[0, :, :2] = 1
    images = true + 0.7
    images[0, :, :2] = true[0, :, :2] + 0.1
    assert object_psnr(images[None], true, masks) == pytest.approx(20, abs=1e-4)
    assert object_psnr(true[None], true, masks) == PSNR_LIMIT
    assert object_psnr(images[None], true, torch.zeros_like(masks)) is None
    # Of an object that fills the image it is the plain metric.
    image, whole = torch.rand(1, 3, 4, 4), torch.ones(1, 1, 4, 4)
    assert object_psnr(image[None], true[:1], whole) == pytest.approx(psnr(image, true[:1]).item(), abs=1e-4)


def test_near_is_an_angle_between_optical_axes():
    def turned(*degrees: float) -> Cameras:
        poses = torch.eye(4).repeat(len(degrees), 1, 1)
        for pose, angle in zip(poses, map(math.radians, degrees), strict=True):
            pose[0, 0] = pose[2, 2] = math.cos(angle)
            pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
        return Cameras(poses, pinhole(60, 8).repeat(len(degrees), 1, 1), (8, 8))

    targets = turned(10, 54, 56, 100, 190, 340, -30)
    assert near_reference(turned(10)[0], targets, 45).tolist() == [True, True, False, False, False, True, True]


def test_the_papers_settings_are_always_in_the_grid_and_marked(tmp_path):
    assert grid([], []) == sorted(PAPER)
    assert set(grid([0, 1], [0.2])) == {(0.0, 0.2), (1.0, 0.2), (0.5, 0.5), (0.0, 0.5)}
    row = {"skip_weight": 0.5, "guidance_weight": 0.5, "diversity": 0.1, "reference_psnr": 20.0}
    for paper in (True, False):
        plot_controls([row | {"paper": paper, "near_object_psnr": None}], tmp_path / "controls.png", "title")
        crimson = (imageio.imread(tmp_path / "controls.png")[..., :3] == (220, 20, 60)).all(-1)
        assert crimson.any() == paper
