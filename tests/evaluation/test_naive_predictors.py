"""Predictions from the input alone: the input on a plane, where its place in other views is known."""

import math
from dataclasses import replace

import pytest
import torch

from completesplat.evaluation.naive_predictors import flat_reference
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.scene import SceneBatch, Views

SIZE = 32
DISTANCE = 4.0
UP = torch.tensor([0.0, -1.0, 0.0])


def scene(matrices: list[torch.Tensor], depth_range: tuple[float, float]) -> SceneBatch:
    """Return a scene whose reference has random pixels, with other views from these poses (world to camera)."""
    count = 1 + len(matrices)
    poses = torch.stack([torch.eye(4), *matrices])
    cameras = Cameras(poses, pinhole(40.0, SIZE).expand(count, 3, 3), (SIZE, SIZE))
    images = torch.rand(count, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    views = Views(images, cameras, torch.ones(count, 1, SIZE, SIZE))
    single = SceneBatch(
        views[0], views[1:], torch.tensor(depth_range), torch.ones(1, SIZE, SIZE), torch.tensor(0), "scene"
    )
    return replace(single.map(lambda tensor: tensor[None]), names=("scene",))


def test_a_camera_that_moves_aside_sees_the_plane_move_by_its_parallax() -> None:
    focal = pinhole(40.0, SIZE)[0, 0].item()
    matrix = torch.eye(4)
    matrix[0, 3] = (
        -5 * DISTANCE / focal
    )  # the camera moves to the right, so that the plane moves by 5 pixels to the left
    scenes = scene([matrix], (DISTANCE - 1, DISTANCE + 1))  # axes that do not meet: the middle of the depth range
    predicted = flat_reference(scenes)[0]
    reference = scenes.reference.images[0]
    torch.testing.assert_close(predicted[0], reference, atol=1e-4, rtol=0)
    torch.testing.assert_close(predicted[1, ..., : SIZE - 5], reference[..., 5:], atol=1e-4, rtol=0)
    border = reference[..., -1:].expand(-1, -1, 5)
    torch.testing.assert_close(predicted[1, ..., -5:], border, atol=1e-4, rtol=0)


@pytest.mark.parametrize("degrees", [30, 180])
def test_the_plane_lies_where_the_optical_axes_meet(degrees: float) -> None:
    """Half a turn around shows the plane from behind: the input, flipped left to right."""
    center = torch.tensor([0.0, 0.0, DISTANCE])
    matrices = []
    for angle in (math.radians(degrees), math.radians(60)):
        eye = center + DISTANCE * torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        matrices.append(look_at(eye, center, UP))
    scenes = scene(matrices, (50.0, 60.0))  # a depth range that says nothing of it
    predicted = flat_reference(scenes)[0]
    reference = scenes.reference.images[0]
    middle = slice(SIZE // 2 - 1, SIZE // 2 + 1)
    seen = predicted[1][:, middle, middle].mean()
    assert seen == pytest.approx(reference[:, middle, middle].mean().item(), abs=0.05)
    if degrees == 180:
        torch.testing.assert_close(predicted[1], reference.flip(-1), atol=1e-3, rtol=0)
