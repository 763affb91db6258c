import math

import pytest
import torch

from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.studies.frusta import level_axes, place_cross, visible_segments


def close(first, second, tolerance=1e-9):
    return torch.allclose(first, torch.tensor(second, dtype=first.dtype), atol=tolerance)


def test_the_cross_stands_where_the_cameras_of_an_orbit_look(orbit):
    sequence = orbit(12, height=1.5, center=(3.0, -1.0, 2.0))
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    assert close(cross.center, [3.0, -1.0, 2.0])


def test_it_stands_in_the_middle_of_the_depth_range_before_cameras_that_look_ahead(walk):
    sequence = walk(*[(0.0, 0.0, 0.05 * i) for i in range(5)], depth_range=(1.0, 3.0))
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    assert close(cross.center, [0, 0, 2 / (1 + 1 / 3)], 1e-5)


def test_it_stands_farther_away_where_the_cameras_would_walk_past_it(walk):
    sequence = walk(*[(0.0, 0.0, 0.5 * i) for i in range(11)], depth_range=(1.0, 100.0))
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    _, depth = project(sequence.cameras, cross.center[None])
    assert (depth > 1).all()
    assert depth[0, 0] < 12


@pytest.mark.parametrize("turned", [1, 12])
def test_it_does_not_stand_where_axes_meet_behind_a_camera(orbit, turned):
    """Around the origin, where the first cameras, or all, look outwards."""
    cameras = orbit(12).cameras
    poses = cameras.world_to_camera.clone()
    poses[:turned] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double() @ poses[:turned]
    wrong = Cameras(poses, cameras.intrinsics, cameras.image_size)
    assert place_cross(wrong, torch.tensor([1.0, 3.0])).center.norm() > 0.3


def test_inverted_poses_do_not_hold_the_cross_in_its_place(orbit):
    """Right poses show an orbit's cross in the middle of all pictures, from where it is looked at."""
    sequence = orbit(12, height=1.0, center=(0.5, 0.0, 0.5))
    inverted = Cameras(sequence.cameras.camera_to_world, sequence.cameras.intrinsics, sequence.cameras.image_size)
    away = {}
    for name, cameras in (("right", sequence.cameras), ("inverted", inverted)):
        pixels, depth = project(cameras, place_cross(cameras, sequence.depth_ranges[0]).center[None])
        away[name] = ((pixels[:, 0] - 12).norm(dim=-1) > 3) | (depth[:, 0] < 0)
    assert away["right"].sum() == 0
    assert away["inverted"].sum() > 6


def test_arms_have_the_angular_size_that_is_documented(orbit):
    sequence = orbit(12, radius=5.0, fov=40.0)
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    expected = 0.3 * 5.0 * math.tan(math.radians(20))
    assert close(cross.arms.norm(dim=-1), [expected] * 3, 1e-5)
    assert cross.square().shape == (4, 2, 3)
    assert close((cross.square()[:, 1] - cross.square()[:, 0]).norm(dim=-1), [2 * expected] * 4, 1e-5)


def test_up_is_the_axis_of_an_orbit_that_looks_down(orbit):
    axes = level_axes(orbit(12, height=1.5).cameras)  # the first camera is at +z
    assert close(axes, [[1, 0, 0], [0, 1, 0], [0, 0, -1]])


def test_without_turns_the_cameras_own_up_is_taken(walk):
    axes = level_axes(walk((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).cameras)
    assert close(axes, [[1, 0, 0], [0, -1, 0], [0, 0, 1]])


def test_a_camera_that_looks_straight_down_has_ahead_at_its_upper_edge(orbit):
    cameras = orbit(12).cameras
    down = torch.eye(4).double()
    down[:3, :3] = torch.tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # it sees -y, its upper edge is at -z
    poses = cameras.world_to_camera.clone()
    poses[0] = down
    axes = level_axes(Cameras(poses, cameras.intrinsics, cameras.image_size))
    assert close(axes, [[1, 0, 0], [0, 1, 0], [0, 0, -1]])


def test_segments_are_cut_off_before_the_camera():
    camera = Cameras(torch.eye(4), pinhole(90.0, 10), (10, 10))  # focal length 5
    segments = torch.tensor(
        [[[0.0, 0, -1], [1, 0, 1]], [[1, 0, 1], [0, 0, -1]], [[0, 0, -1], [0, 0, 0]], [[0, 1, 2], [1, 1, 2]]]
    )
    result = dict(visible_segments(camera, segments, nearest=0.5))
    assert sorted(result) == [0, 1, 3]
    # At depth 0.5 the first one has x = 0.75.
    assert close(result[0], [[12.5, 5], [10, 5]], 1e-5)
    assert close(result[1], [[10, 5], [12.5, 5]], 1e-5)
    assert close(result[3], [[5, 7.5], [7.5, 7.5]], 1e-5)


@pytest.mark.parametrize("count", [1, 2])
def test_the_fewest_cameras_get_a_cross(orbit, count):
    sequence = orbit(count)
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    assert cross.center.isfinite().all()
    assert cross.arms.isfinite().all()
