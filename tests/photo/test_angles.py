"""Cameras of photos that are known by their angles."""

import math

import pytest
import torch

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import pinhole, project
from completesplat.photo.angles import cameras_by_angles, distances_by_size, up_of_first

SIZE = 64
LENS = pinhole(40.0, SIZE)


def lenses(count: int) -> torch.Tensor:
    return LENS.expand(count, 3, 3)


def test_at_90_degrees_the_camera_has_moved_to_its_right_by_a_quarter_turn() -> None:
    cameras = cameras_by_angles(lenses(3), SIZE, [0, 90, 180], [0, 0, 0], [2, 2, 2])
    expected = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 2.0], [0.0, 0.0, 4.0]])  # x right, y down, z forward
    torch.testing.assert_close(cameras.centers, expected, atol=1e-5, rtol=0)
    center, _ = project(cameras, torch.tensor([[0.0, 0.0, 2.0]]))
    torch.testing.assert_close(center[:, 0], torch.full((3, 2), SIZE / 2), atol=1e-3, rtol=0)


def test_a_higher_camera_looks_down_and_knows_where_up_is() -> None:
    cameras = cameras_by_angles(lenses(2), SIZE, [10, 10], [0, 30], [2, 2])
    assert cameras.centers[1, 1] == pytest.approx(-1.0, abs=1e-5)
    first = cameras_by_angles(lenses(2), SIZE, [10, 10], [30, 0], [2, 2])
    lower = first.centers[1]
    up = up_of_first(30)
    center = torch.tensor([0.0, 0.0, 2.0])
    assert up.norm() == pytest.approx(1)
    assert torch.dot(lower - center, up) == pytest.approx(0, abs=1e-5)  # the level camera is as high as the object
    assert torch.dot(-center, up) == pytest.approx(2 * math.sin(math.radians(30)), abs=1e-5)


def test_an_object_that_looks_half_as_high_is_twice_as_far() -> None:
    large = torch.zeros(1, SIZE, SIZE)
    large[:, 10:50, 20:30] = 1
    small = torch.zeros(1, SIZE, SIZE)
    small[:, 20:40, 5:60] = 1
    assert distances_by_size([large, small], lenses(2), [0, 90]) == [1, 2]
    longer = torch.stack([LENS, LENS * LENS.new_tensor([[2.0], [2.0], [1.0]])])
    assert distances_by_size([large, large], longer, [0, 90]) == [1, 2]
    assert distances_by_size([large, None], lenses(2), [0, 90]) == [1, 1]
    with pytest.raises(CompleteSplatError, match="the photo at 90 degrees shows no object"):
        distances_by_size([large, torch.zeros(1, SIZE, SIZE)], lenses(2), [0, 90])
