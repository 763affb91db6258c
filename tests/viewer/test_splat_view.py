"""Places of samples on the page, its camera, and conversion to viser's splats."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from viewer_scenes import balls, balls_sample

from completesplat.gaussians import merge_gaussians
from completesplat.geometry.cameras import look_at, transform_points
from completesplat.viewer.splat_view import MARGIN, arrangement_of, depth_colored, to_splats


def test_one_sample_is_seen_as_its_reference_camera_sees_it_with_a_margin():
    sample = balls_sample()
    eye = torch.tensor([1.0, -2.0, 0.5])
    pose = look_at(eye, torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, -1.0, 0.0]))
    arrangement = arrangement_of([replace(sample, reference=replace(sample.reference, world_to_camera=pose))])
    assert arrangement.position == pytest.approx(eye.numpy(), abs=1e-5)
    direction = (arrangement.look_at - arrangement.position) / arrangement.distance
    assert direction == pytest.approx(pose[2, :3].numpy(), abs=1e-5)
    assert np.tan(arrangement.fov / 2) == pytest.approx(MARGIN * np.tan(np.radians(25)))
    assert arrangement.shift(0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("count", [2, 8])
def test_all_of_a_row_are_in_view_and_none_overlap(count):
    arrangement = arrangement_of([balls_sample()] * count)
    shifts = np.stack([arrangement.shift(i) for i in range(count)])
    assert shifts.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-5)
    width = 2 * arrangement.pivots[0][2].item() * np.tan(np.radians(25))  # the width that its camera sees there
    assert (np.diff(shifts[:, 0]) > width).all()
    half_width = arrangement.distance * np.tan(arrangement.fov / 2) * 1.1  # a window a little wider than high
    assert abs(shifts[:, 0]).max() + width / 2 < half_width


def test_side_by_side_samples_reach_no_further_than_to_the_middle_between_them():
    """A scene's floor and walls are far larger than the image of its object: whole ones would hide each other."""
    sample = balls_sample()
    wall = balls()
    wall = replace(wall, means=wall.means * torch.tensor([30.0, 30, 1]))
    large = replace(wall[:4], means=sample.pivot().expand(4, 3), scales=torch.full((4, 3), 3.0))
    scene = merge_gaussians([sample.gaussians, wall, large])
    both = arrangement_of([replace(sample, gaussians=scene)] * 2)
    part = both.beside(1, scene)
    assert part.count >= sample.gaussians.count - 60  # the yellow ball's far side is outside
    reach = (part.means - both.pivots[1]).norm(dim=-1) + 2 * part.scales.amax(-1)
    assert reach.max() <= both.spacing / 2
    alone = arrangement_of([replace(sample, gaussians=scene)])
    assert alone.beside(0, scene).count == scene.count


@pytest.mark.parametrize("count", [1, 3])
def test_narrow_windows_show_as_much_to_the_sides_as_wide_ones(count):
    arrangement = arrangement_of([balls_sample()] * count)
    assert arrangement.fov_in(2.0) == arrangement.fov
    sides = [np.tan(arrangement.fov_in(aspect) / 2) * aspect for aspect in (0.3, 390 / 844, arrangement.aspect)]
    assert sides == pytest.approx([sides[0]] * 3)


def test_a_camera_stays_while_the_scene_changes_a_little():
    sample = balls_sample()
    arrangement = arrangement_of([sample])
    nudged = replace(sample, gaussians=replace(sample.gaussians, means=sample.gaussians.means * 1.01))
    assert arrangement_of([nudged]).looks_like(arrangement)
    assert not arrangement_of([sample, sample]).looks_like(arrangement)
    aside = look_at(torch.tensor([3.0, 0, 4]), torch.tensor([0.0, 0, 4]), torch.tensor([0.0, -1, 0]))
    turned = replace(sample, reference=replace(sample.reference, world_to_camera=aside))
    assert not arrangement_of([turned]).looks_like(arrangement)


def test_covariances_have_the_rotated_axes_and_squared_scales():
    """The variance along each of a Gaussian's axes, found by rotating unit vectors one by one, is its scale squared."""
    gaussians = balls(points=5)
    splats, unit = to_splats(gaussians)
    parts = gaussians.quaternions.numpy(), gaussians.scales.numpy(), splats["covariances"]
    for quaternion, scales, covariance in zip(*parts, strict=True):
        w, *xyz = (quaternion / np.linalg.norm(quaternion)).tolist()
        for axis, scale in zip(np.eye(3), scales, strict=True):
            turned = axis + 2 * np.cross(xyz, np.cross(xyz, axis) + w * axis)  # of the quaternion product q v q*
            assert turned @ covariance @ turned * unit**2 == pytest.approx(scale**2, rel=1e-4)
            assert covariance @ turned == pytest.approx(turned * (scale / unit) ** 2, rel=1e-3, abs=1e-1)


@pytest.mark.parametrize("size", [1e-4, 1e4])
def test_half_precision_keeps_the_shapes_at_every_size(size):
    gaussians = balls(points=5)
    scaled, unit = to_splats(replace(gaussians, scales=gaussians.scales * size))
    halves = scaled["covariances"].astype(np.float16).astype(np.float64)
    assert np.isfinite(halves).all()
    for half, scales in zip(halves, gaussians.scales.numpy() * size, strict=True):
        deviations = np.sqrt(np.linalg.eigvalsh(half)) * unit
        assert deviations == pytest.approx(np.sort(scales), rel=0.01)


def test_centers_and_bytes_of_finite_gaussians():
    gaussians = balls(points=2)
    gaussians.colors[0] = torch.tensor([2.0, 0.5, 0.0])
    splats, unit = to_splats(gaussians)
    assert splats["centers"] * unit == pytest.approx(gaussians.means.numpy(), rel=1e-5, abs=1e-5)
    assert splats["rgbs"][0].tolist() == [255, 128, 0]
    assert splats["opacities"].tolist() == [[204]] * gaussians.count
    gaussians.means[3, 1], gaussians.scales[5, 0] = torch.nan, torch.inf
    splats, _ = to_splats(gaussians)
    assert len(splats["centers"]) == gaussians.count - 2
    assert all(np.isfinite(part).all() for part in splats.values())
    assert to_splats(gaussians[:0])[0]["centers"].shape == (0, 3)


def test_depth_colours_brighten_towards_the_camera_on_one_scale():
    near = balls(points=50)
    far = balls(points=50)
    far.means[:, 2] += 1
    eye = torch.tensor([-3.0, 0, 1])
    ahead = torch.tensor([5.0, 0, 1])
    sideways = replace(balls_sample().reference, world_to_camera=look_at(eye, ahead, torch.tensor([0.0, 0, 1])))
    depths = transform_points(sideways.world_to_camera, near.means)[:, 2]
    by_depth = depth_colored([near], [sideways])[0].colors.sum(-1)[depths.argsort()]
    assert (by_depth.diff() <= 1e-5).all()
    scenes = depth_colored([near, far], [balls_sample().reference] * 2)
    depths = torch.cat([near.means[:, 2], far.means[:, 2]])
    lightness = torch.cat([scene.colors.sum(-1) for scene in scenes])[depths.argsort()]
    assert (lightness.diff() <= 1e-5).all()
    assert lightness[0] > lightness[-1] + 1
    assert torch.equal(scenes[1].means, far.means)
