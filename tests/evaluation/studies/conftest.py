"""Sequences of cameras whose figures have closed forms."""

import math
from collections.abc import Callable

import pytest
import torch

from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.geometry.cameras import Cameras, look_at, pinhole

SIZE = 24


def posed(world_to_camera, read, fov=50.0, depth_range=(1.0, 3.0), name="sequence") -> PosedSequence:
    count = len(world_to_camera)
    cameras = Cameras(world_to_camera, pinhole(fov, SIZE).double().repeat(count, 1, 1), (SIZE, SIZE))
    frames = tuple(range(100, 100 + count))
    return PosedSequence(name, frames, cameras, torch.tensor(depth_range).float().repeat(count, 1), read)


def grey_image(index: int) -> MaskedImage:
    return MaskedImage(torch.full((3, SIZE, SIZE), 120, dtype=torch.uint8), None)


@pytest.fixture
def orbit() -> Callable[..., PosedSequence]:
    """Cameras at equal steps of `turn` degrees in all (both ends are there if it is less than 360) around a point."""

    def make(count=24, radius=2.0, height=0.0, center=(0.0, 0.0, 0.0), turn=360.0, read=grey_image, **rest):
        steps = torch.arange(count, dtype=torch.float64) / (count if turn == 360 else count - 1)
        angles = math.radians(turn) * steps
        eyes = torch.stack([radius * angles.sin(), torch.full_like(angles, height), radius * angles.cos()], dim=-1)
        middle, up = torch.tensor(center).double(), torch.tensor([0.0, 1.0, 0.0]).double()
        return posed(look_at(eyes + middle, middle, up), read, **rest)

    return make


@pytest.fixture
def walk() -> Callable[..., PosedSequence]:
    """Cameras with the world's axes (+y down) at the given places."""

    def make(*centers, read=grey_image, **rest):
        poses = torch.eye(4).double().repeat(len(centers), 1, 1)
        poses[:, :3, 3] = -torch.tensor(centers).double()
        return posed(poses, read, **rest)

    return make
