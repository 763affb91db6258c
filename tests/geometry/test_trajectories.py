"""Camera paths: distances, heights, angles and the direction of turning."""

import math

import pytest
import torch
from torch import Tensor

from completesplat.geometry.cameras import Cameras, look_at, pinhole, project
from completesplat.geometry.trajectories import PATHS, orbit, swipe, wobble

PIVOT = torch.tensor([0.3, -0.2, 2.5], dtype=torch.float64)
UP = torch.tensor([0.1, -2.0, 0.2], dtype=torch.float64)  # neither of unit length nor along an axis


def reference_camera() -> Cameras:
    eye = torch.tensor([0.5, -1.0, -0.4], dtype=torch.float64)
    aim = torch.tensor([0.0, 0.1, 2.0], dtype=torch.float64)
    return Cameras(look_at(eye, aim, UP), pinhole(60, 64).double(), (64, 64))


def horizontal(vectors: Tensor) -> Tensor:
    axis = UP / UP.norm()
    return vectors - (vectors @ axis)[:, None] * axis


def test_orbit_starts_at_the_reference_and_turns_counter_clockwise_at_its_distance_and_height() -> None:
    """Seen from above. Each camera lies to the right of the one before it."""
    reference = reference_camera()
    cameras = orbit(reference, PIVOT, UP, frames=17)
    arms = cameras.centers - PIVOT
    torch.testing.assert_close(arms[0], reference.centers - PIVOT)
    torch.testing.assert_close(arms.norm(dim=-1), arms[:1].norm(dim=-1).expand(17))
    torch.testing.assert_close(arms @ UP, (arms[:1] @ UP).expand(17))
    assert (torch.linalg.cross(arms[:-1], arms[1:]) @ UP > 0).all()
    assert ((cameras.world_to_camera[:-1, 0, :3] * arms.diff(dim=0)).sum(-1) > 0).all()


@pytest.mark.parametrize(("frames", "degrees"), [(8, 360.0), (5, 90.0), (3, -60.0)])
def test_steps_of_an_orbit_are_even_and_end_one_short(frames: int, degrees: float) -> None:
    arms = horizontal(orbit(reference_camera(), PIVOT, UP, frames, degrees).centers - PIVOT)
    following = torch.cat([arms[1:], arms[:1]])
    cosines = torch.cosine_similarity(arms, following, dim=-1)
    steps = frames if degrees == 360.0 else frames - 1  # only a full turn closes
    expected = math.cos(math.radians(degrees / frames))
    torch.testing.assert_close(cosines[:steps], torch.full((steps,), expected, dtype=torch.float64))


@pytest.mark.parametrize("name", sorted(PATHS))
def test_every_camera_of_every_path_sees_the_pivot_in_its_centre_and_up_above_it(name: str) -> None:
    cameras = PATHS[name](reference_camera(), PIVOT, UP, 12)
    pixels, depths = project(cameras, torch.stack([PIVOT, PIVOT + 0.1 * UP]).expand(12, 2, 3))
    torch.testing.assert_close(pixels[:, 0], torch.full((12, 2), 32.0, dtype=torch.float64))
    assert (depths > 0).all()
    assert (pixels[:, 1, 1] < 32).all()
    torch.testing.assert_close(pixels[:, 1, 0], pixels[:, 0, 0])
    assert cameras.image_size == (64, 64)
    assert torch.equal(cameras.intrinsics, reference_camera().intrinsics.expand(12, 3, 3))


@pytest.mark.parametrize("name", sorted(PATHS))
def test_every_path_loops_smoothly(name: str) -> None:
    """Also over the seam, no step and no change of step is larger than on a smooth curve of so many frames."""
    frames = 240
    centers = PATHS[name](reference_camera(), PIVOT, UP, frames).centers
    speed = centers.roll(-1, 0) - centers
    size = (centers - centers.mean(0)).norm(dim=-1).max()
    turn = 2 * math.pi / frames
    assert speed.norm(dim=-1).max() < 1.01 * turn * size
    assert (speed.roll(-1, 0) - speed).norm(dim=-1).max() < 1.01 * turn**2 * size


def test_swipe_goes_left_then_right_on_a_level_line_and_comes_back() -> None:
    reference = reference_camera()
    offsets = swipe(reference, PIVOT, UP, frames=16, reach=0.25).centers - reference.centers
    distance = (reference.centers - PIVOT).norm()
    right = swipe(reference, PIVOT, UP, frames=1).world_to_camera[0, 0, :3]
    along = offsets @ right
    torch.testing.assert_close(offsets, along[:, None] * right)
    torch.testing.assert_close(right @ UP, torch.zeros((), dtype=torch.float64))
    assert along.argmin() == 4
    assert along.argmax() == 12
    torch.testing.assert_close(along[[0, 4, 8, 12]] / distance, torch.tensor([0, -0.25, 0, 0.25], dtype=torch.float64))


def test_wobble_circles_the_reference_camera_across_the_line_of_sight() -> None:
    reference = reference_camera()
    offsets = wobble(reference, PIVOT, UP, frames=8, radius=0.05).centers - reference.centers
    sight = PIVOT - reference.centers
    torch.testing.assert_close(offsets.norm(dim=-1), (0.05 * sight.norm()).expand(8))
    torch.testing.assert_close(offsets @ sight, torch.zeros(8, dtype=torch.float64))
    angles = torch.cosine_similarity(offsets, offsets.roll(-1, 0), dim=-1)
    torch.testing.assert_close(angles, torch.full((8,), math.cos(math.pi / 4), dtype=torch.float64))
    assert (offsets[2] @ UP) > 0
    assert (offsets[0] @ UP).abs() < 1e-12
