"""The synthetic batch of planned and timed steps."""

import torch

from completesplat.geometry.cameras import project
from completesplat.training.steps import DISTANCE, synthetic_batch


def test_the_cameras_of_the_synthetic_batch_look_at_one_point_within_the_depth_range() -> None:
    scenes = synthetic_batch(16, 3, 2)
    views = scenes.all_views()
    assert views.images.shape == (3, 3, 3, 16, 16)
    torch.testing.assert_close(scenes.reference.cameras.world_to_camera, torch.eye(4).expand(3, 4, 4))
    near, far = scenes.depth_range[0].tolist()
    axis = torch.linspace(near, far, 99)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    pixels, _ = project(views.cameras, axis)
    assert (pixels - 8).abs().amax((0, 1, 3)).min() < 0.1
    assert near < DISTANCE < far
