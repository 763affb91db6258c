"""Faithfulness in closed form."""

import math

import pytest
import torch

from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.metrics.images import PSNR_LIMIT, psnr
from completesplat.studies.samples import near, object_psnr


def test_object_pixels_alone_count():
    true, masks = torch.rand(2, 3, 4, 4), torch.zeros(2, 1, 4, 4)
    masks[0, :, :2] = 1
    images = true.clone()
    images[0, :, :2] += 0.1
    images[0, :, 2:] += 0.7
    images[1] += 0.7
    assert object_psnr(images[None], true, masks) == pytest.approx(20, abs=1e-4)
    assert object_psnr(true[None], true, masks) == PSNR_LIMIT
    assert object_psnr(images[None], true, torch.zeros_like(masks)) is None


def test_of_an_object_that_fills_the_picture_it_is_the_plain_metric():
    true, image = torch.rand(2, 1, 3, 16, 16).unbind(0)
    expected = psnr(image, true).item()
    assert object_psnr(image[None], true, torch.ones(1, 1, 16, 16)) == pytest.approx(expected, abs=1e-4)


def test_near_is_an_angle_between_optical_axes():
    def turned(*degrees: float) -> Cameras:
        poses = torch.eye(4).repeat(len(degrees), 1, 1)
        for pose, angle in zip(poses, map(math.radians, degrees), strict=True):
            pose[0, 0] = pose[2, 2] = math.cos(angle)
            pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
        return Cameras(poses, pinhole(60, 8).repeat(len(degrees), 1, 1), (8, 8))

    targets = turned(10, 54, 56, 100, 190, 340, -30)
    assert near(turned(10)[0], targets, 45).tolist() == [True, True, False, False, False, True, True]
