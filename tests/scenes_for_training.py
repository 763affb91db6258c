"""Scenes without files, for tests of what surrounds training."""

import torch

from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.scene import SceneBatch, Views

SIZE = 16


def scene_batch(batch: int = 2, targets: int = 2, seed: int = 0, size: int = SIZE) -> SceneBatch:
    """Random images, all from one camera at the origin."""
    count = 1 + targets
    cameras = Cameras(
        torch.eye(4).repeat(batch, count, 1, 1), pinhole(60, size).repeat(batch, count, 1, 1), (size, size)
    )
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, size, size, generator=generator)
    views = Views(images, cameras, torch.ones(batch, count, 1, size, size))
    return SceneBatch(
        views[:, 0], views[:, 1:], torch.tensor([[0.5, 4.0]]).repeat(batch, 1), torch.ones(batch, 1, size, size),
        torch.zeros(batch, dtype=torch.int64), tuple(f"scene {seed} {i}" for i in range(batch)),
    )  # fmt: skip
