"""Training steps of the benchmarks: their synthetic batch, and the share of the rasterizer."""

import pytest
import torch
from support import compose_config

from completesplat.benchmarks import training_step
from completesplat.benchmarks.training_step import share
from completesplat.benchmarks.workloads import Backend
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, project
from completesplat.rasterizers import Rendering
from completesplat.rasterizers.tiled import TiledRasterizer
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


@pytest.mark.parametrize(("name", "steps", "timed"), [("tiled", 3, 2), ("gsplat_torch", 2, 1)])
def test_the_rasterizer_takes_a_share_of_a_step(name: str, steps: int, timed: int, monkeypatch) -> None:
    for setting, value in (("UNTIMED_STEPS", 1), ("TIMED_STEPS", 2), ("SLOW", {"gsplat_torch": (1, 1)})):
        monkeypatch.setattr(training_step, setting, value)
    renders: list[tuple[int, ...]] = []

    def render(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        renders.append((*cameras.intrinsics.shape[:2], *cameras.image_size))
        return TiledRasterizer()(gaussians, cameras)

    row = share(Backend(name, render), compose_config("bench").model, 32, 2, 1, "32-true")
    assert renders == [(2, 2, 32, 32)] * (steps + timed)
    assert [row[key] for key in ("backend", "size", "batch", "views")] == [name, 32, 2, 2]
    assert 0 < row["rasterizer_ms"] < row["step_ms"]
    assert row["share"] == row["rasterizer_ms"] / row["step_ms"]
