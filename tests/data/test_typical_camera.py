import math

import pytest
import torch

from completesplat.data.loading.training_statistics import typical_camera, world_up
from completesplat.geometry.cameras import Cameras, look_at, pinhole


def level_orbit(up: torch.Tensor, elevation: float, frames: int = 12) -> Cameras:
    """Cameras held level at one elevation (radians), looking at a point that is not the origin."""
    side = torch.linalg.cross(up, torch.tensor([0.3, 0.5, -0.8], dtype=up.dtype))
    side = side / side.norm()
    other = torch.linalg.cross(up, side)
    angles = torch.linspace(0, 5, frames, dtype=up.dtype)[:, None]
    level = angles.cos() * side + angles.sin() * other
    target = torch.tensor([1.0, 2.0, 3.0], dtype=up.dtype)
    eyes = target + 2 * (math.cos(elevation) * level + math.sin(elevation) * up)
    intrinsics = pinhole(60.0, 32).to(up.dtype).expand(frames, 3, 3)
    return Cameras(look_at(eyes, target, up), intrinsics, (32, 32))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("elevation", [-0.4, 0.0, 0.9])
def test_world_up_is_found_from_level_cameras(seed, elevation):
    torch.manual_seed(seed)
    up = torch.nn.functional.normalize(torch.randn(3, dtype=torch.float64), dim=0)
    torch.testing.assert_close(world_up(level_orbit(up, elevation)), up)


def test_cameras_that_do_not_turn_have_their_own_up():
    pose = look_at(torch.tensor([[1.0, 2, 3]]), torch.zeros(3), torch.tensor([0.0, -1, 0])).expand(2, 4, 4)
    pair = Cameras(pose, pinhole(60.0, 32).expand(2, 3, 3), (32, 32))
    torch.testing.assert_close(world_up(pair), -pose[0, 1, :3])


def test_typical_camera_of_known_cameras_counts_sequences_by_their_frames():
    up = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    ranges = torch.tensor([[1.0, 3.0]], dtype=torch.float64).expand(12, 2)
    camera = typical_camera([level_orbit(up, 0.2), level_orbit(up, 0.2, frames=4)], [ranges, ranges[:4] + 1])
    assert camera.fov_degrees == pytest.approx(60, abs=1e-4)
    assert camera.depth_range == pytest.approx((1.25, 3.25))
    # A camera that looks down by 0.2 sees up tilted away from its own up, backwards.
    assert camera.up == pytest.approx((0, -math.cos(0.2), -math.sin(0.2)), abs=1e-6)
