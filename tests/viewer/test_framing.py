from dataclasses import replace

import numpy as np
import pytest
import torch
from viewer_scenes import balls_sample

from completesplat.geometry.cameras import Cameras, invert_rigid, look_at
from completesplat.viewer.stage import framing_of


def test_one_sample_is_seen_as_its_reference_camera_sees_it():
    sample = balls_sample()
    eye = torch.tensor([1.0, -2.0, 0.5])
    pose = look_at(eye, torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, -1.0, 0.0]))
    framing = framing_of([replace(sample, reference=replace(sample.reference, world_to_camera=pose))])
    assert framing.position == pytest.approx(eye.numpy(), abs=1e-5)
    direction = (framing.look_at - framing.position) / framing.distance
    assert direction == pytest.approx(pose[2, :3].numpy(), abs=1e-5)
    assert np.degrees(framing.fov) == pytest.approx(50, abs=1e-3)
    assert framing.shift(0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("count", [2, 3, 8])
def test_all_of_a_row_are_in_view_and_none_overlap(count):
    sample = balls_sample()
    framing = framing_of([sample] * count)
    shifts = np.stack([framing.shift(i) for i in range(count)])
    assert shifts.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-5)
    picture = 2 * framing.pivots[0][2].item() * np.tan(np.radians(25))  # the width that the reference camera sees there
    assert (np.diff(shifts[:, 0]) > picture).all()
    half_width = framing.distance * np.tan(framing.fov / 2) * 1.1  # a window a little wider than high
    assert abs(shifts[:, 0]).max() + picture / 2 < half_width


def test_a_camera_stays_while_the_scene_changes_a_little():
    sample = balls_sample()
    one = framing_of([sample])
    nudged = replace(sample, gaussians=replace(sample.gaussians, means=sample.gaussians.means * 1.01))
    assert framing_of([nudged]).looks_like(one)
    assert not framing_of([sample, sample]).looks_like(one)
    turned = invert_rigid(look_at(torch.tensor([3.0, 0, 4]), torch.tensor([0.0, 0, 4]), torch.tensor([0.0, -1, 0])))
    camera = Cameras(invert_rigid(turned), sample.reference.intrinsics, sample.reference.image_size)
    assert not framing_of([replace(sample, reference=camera)]).looks_like(one)
