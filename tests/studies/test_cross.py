"""The cross that stands at one place of a scene."""

import math

import torch

from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.studies.contact_sheet import level_axes, place_cross, visible_segments


def close(first, second, tolerance=1e-9):
    return torch.allclose(first, torch.tensor(second, dtype=first.dtype), atol=tolerance)


def crossed(sequence):
    return place_cross(sequence.cameras, sequence.depth_ranges[0])


def test_the_cross_stands_where_the_cameras_look_or_in_the_middle_of_the_depth_range_ahead(orbit, walk):
    assert close(crossed(orbit(12, height=1.5, center=(3.0, -1.0, 2.0))).center, [3.0, -1.0, 2.0])
    ahead = walk(*[(0.0, 0.0, 0.05 * i) for i in range(5)], depth_range=(1.0, 3.0))
    assert close(crossed(ahead).center, [0, 0, 0.1 + 2 / (1 + 1 / 3)], 1e-5)


def test_inverted_poses_do_not_hold_the_cross_in_its_place(orbit):
    sequence = orbit(12, height=1.0, center=(0.5, 0.0, 0.5))
    inverted = Cameras(sequence.cameras.camera_to_world, sequence.cameras.intrinsics, sequence.cameras.image_size)
    away = {}
    for name, cameras in (("right", sequence.cameras), ("inverted", inverted)):
        pixels, depth = project(cameras, place_cross(cameras, sequence.depth_ranges[0]).center[None])
        away[name] = ((pixels[:, 0] - 12).norm(dim=-1) > 3) | (depth[:, 0] < 0)
    assert away["right"].sum() == 0
    assert away["inverted"].sum() > 6


def test_arms_have_the_angular_size_that_is_documented(orbit):
    cross = crossed(orbit(12, radius=5.0, fov=40.0))
    expected = 0.3 * 5.0 * math.tan(math.radians(20))
    assert close(cross.arms.norm(dim=-1), [expected] * 3, 1e-5)
    for few in map(crossed, (orbit(1), orbit(2))):
        assert few.center.isfinite().all()
        assert few.arms.isfinite().all()


def test_up_is_the_axis_of_an_orbit_or_the_cameras_own(orbit, walk):
    assert close(level_axes(orbit(12, height=1.5).cameras), [[1, 0, 0], [0, 1, 0], [0, 0, -1]])  # from +z, down
    assert close(level_axes(walk((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).cameras), [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    cameras = orbit(12).cameras
    poses = cameras.world_to_camera.clone()
    # The first one sees -y: ahead is at its upper edge, at -z.
    poses[0] = torch.block_diag(torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), torch.ones(1, 1))
    axes = level_axes(Cameras(poses, cameras.intrinsics, cameras.image_size))
    assert close(axes, [[1, 0, 0], [0, 1, 0], [0, 0, -1]])


def test_segments_are_cut_off_before_the_camera():
    camera = Cameras(torch.eye(4), pinhole(90.0, 10), (10, 10))  # focal length 5
    far, behind = [1.0, 0, 1], [0.0, 0, -1]
    segments = torch.tensor([[behind, far], [far, behind], [behind, [0, 0, 0]], [[0, 1, 2], [1, 1, 2]]])
    result = dict(visible_segments(camera, segments, nearest=0.5))
    assert sorted(result) == [0, 1, 3]
    # At depth 0.5 the first one has x = 0.75.
    assert close(result[0], [[12.5, 5], [10, 5]], 1e-5)
    assert close(result[1], [[10, 5], [12.5, 5]], 1e-5)
    assert close(result[3], [[5, 7.5], [7.5, 7.5]], 1e-5)
