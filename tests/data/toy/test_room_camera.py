"""The camera's walk through a toy room, and its lens."""

import numpy as np
import pytest

from completesplat.data.toy.room_scene import HIGHEST, LOWEST, MARGIN, draw_room_scene, image_width


def scene(index: int, frames: int = 60):
    return draw_room_scene(np.random.default_rng([7, index]), frames)


@pytest.mark.parametrize("index", range(30))
def test_the_camera_walks_smoothly_through_free_space(index):
    """Away from walls and furniture, at a person's height, upright, in small even steps and small turns."""
    room = scene(index)
    poses, half = room.move.camera_to_room, room.room.size / 2
    centers, forward = poses[:, :3, 3], poses[:, :3, 2]
    assert (np.abs(centers[:, [0, 2]]) <= half[[0, 2]] - MARGIN).all()
    assert (centers[:, 1] >= LOWEST).all()
    assert (centers[:, 1] <= HIGHEST).all()
    for solid in room.furniture:
        corner = np.abs(np.concatenate([centers, np.ones((60, 1))], axis=1) @ solid.to_local().T).clip(1) - 1
        assert np.linalg.norm(corner * solid.half_sizes, axis=1).min() >= MARGIN - 1e-9
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 0.04
    assert steps.max() < 1.2 * steps.min()
    turns = np.degrees(np.arccos((forward[1:] * forward[:-1]).sum(axis=1).clip(-1, 1)))
    assert turns.max() < 3.5
    assert (poses[:, 1, 1] < -0.9).all()  # the pictures' down is the room's down
    assert np.abs(poses[:, 1, 0]).max() < 1e-9  # and their rows are level
    along = np.diff(centers, axis=0) / steps[:, None]
    assert ((along * forward[1:]).sum(axis=1) > 0.6).all()


def test_pixels_are_square_and_pictures_about_sixteen_by_nine():
    for height in (8, 18, 64, 65, 360):
        width = image_width(height)
        assert width % 2 == 0
        assert abs(width - height * 16 / 9) <= 1
        fx, fy, _, _ = scene(0, frames=2).move.intrinsics(height, width)
        assert fx * width == pytest.approx(fy * height)
    assert image_width(360) == 640
