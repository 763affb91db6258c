"""The share of the rasterizer in a training step: the stop watch counts its seconds and changes nothing else."""

from types import SimpleNamespace

import pytest
import torch
from rasterizer_scenes import cotangents_for, render_with_gradients, scenes
from support import compose_config
from torch import Tensor

from completesplat.benchmarks import training_step
from completesplat.benchmarks.training_step import StopWatch, share, synthetic_batch
from completesplat.benchmarks.workloads import DISTANCE, Backend, splatter_scene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, project
from completesplat.rasterizers import Rendering, RenderingConstants
from completesplat.rasterizers.tiled import TiledRasterizer

NETWORK, RASTERIZER = (100.0, 200.0), (2.0, 3.0)  # seconds that it takes forward and backward


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Stands still, but while something below is at work."""
    clock = SimpleNamespace(now=0.0)
    clock.perf_counter = lambda: clock.now
    monkeypatch.setattr(training_step, "time", clock)
    return clock


class Busy(torch.autograd.Function):
    """Hands a tensor on, which takes its time."""

    @staticmethod
    def forward(ctx, tensor: Tensor, clock: SimpleNamespace, seconds: tuple[float, float]) -> Tensor:
        ctx.clock, ctx.seconds = clock, seconds
        clock.now += seconds[0]
        return tensor.clone()

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple:
        ctx.clock.now += ctx.seconds[1]
        return gradient, None, None


def test_seconds_are_those_of_both_passes_and_of_nothing_else(clock: SimpleNamespace) -> None:
    def draw(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        value = Busy.apply(sum(tensor.mean() for tensor in vars(gaussians).values()), clock, RASTERIZER)
        return Rendering(*(value.expand(1, 2, channels, *cameras.image_size) for channels in (3, 1, 1)))

    watch = StopWatch(draw)
    gaussians, cameras = splatter_scene(4, 2, "trained")
    weight = torch.ones((), requires_grad=True)
    for step in range(1, 3):
        beside = Busy.apply(weight, clock, NETWORK)  # a term of the loss that the rasterizer is not part of
        before = Busy.apply(weight, clock, NETWORK)
        rendering = watch(gaussians.map(before.mul), cameras)
        after = Busy.apply(rendering.color.sum() + rendering.alpha.sum(), clock, NETWORK)
        assert watch.seconds == (step - 1) * sum(RASTERIZER) + RASTERIZER[0]
        (after + beside + Busy.apply(weight, clock, NETWORK)).backward()
        assert watch.seconds == step * sum(RASTERIZER)
    assert clock.now == 2 * (4 * sum(NETWORK) + sum(RASTERIZER))


def test_the_watched_rasterizer_renders_the_same() -> None:
    gaussians, cameras = scenes(0, 2, 2, (11, 14), RenderingConstants(), count=20)
    (alone, gradients), (watched, watched_gradients) = (
        render_with_gradients(rasterizer, gaussians, cameras, cotangents_for(cameras, 0))
        for rasterizer in (TiledRasterizer(), StopWatch(TiledRasterizer()))
    )
    for name, tensor in (vars(alone) | gradients).items():
        assert torch.equal(tensor, (vars(watched) | watched_gradients)[name]), name


def test_no_zeros_are_made_where_the_loss_sends_no_gradient() -> None:
    noted: list[Tensor | None] = []

    def draw(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        value = sum(tensor.mean() for tensor in vars(gaussians).values())
        images = value.expand(1, 1, 5, *cameras.image_size).split([3, 1, 1], dim=2)
        images[0].grad_fn.register_prehook(noted.extend)
        return Rendering(*images)

    gaussians, cameras = splatter_scene(4, 1, "trained")
    StopWatch(draw)(gaussians.map(lambda tensor: tensor.requires_grad_()), cameras).color.sum().backward()
    assert [gradient is None for gradient in noted] == [False, True, True]


def test_the_synthetic_batch_is_one_of_a_data_module() -> None:
    scenes = synthetic_batch(16, 3, 2)
    views = scenes.all_views()
    assert views.images.shape == (3, 3, 3, 16, 16)
    assert len(scenes.names) == 3
    torch.testing.assert_close(scenes.reference.cameras.world_to_camera, torch.eye(4).expand(3, 4, 4))
    # All cameras look at one point, which lies within the depth range.
    near, far = scenes.depth_range[0].tolist()
    axis = torch.linspace(near, far, 99)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    pixels, _ = project(views.cameras, axis)
    assert (pixels - 8).abs().amax((0, 1, 3)).min() < 0.1
    assert near < DISTANCE < far


@pytest.mark.parametrize(("name", "steps"), [("tiled", 3), ("gsplat_torch", 2)])
def test_the_rasterizer_takes_a_share_of_a_step(name: str, steps: int, monkeypatch) -> None:
    for setting, value in (("UNTIMED_STEPS", 1), ("TIMED_STEPS", 2), ("SLOW", {"gsplat_torch": (1, 1)})):
        monkeypatch.setattr(training_step, setting, value)
    renders: list[tuple[int, ...]] = []

    def render(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        renders.append((*cameras.intrinsics.shape[:2], *cameras.image_size))
        return TiledRasterizer()(gaussians, cameras)

    row = share(Backend(name, render), compose_config("bench").model, 32, 2, 1, "32-true")
    assert renders == [(2, 2, 32, 32)] * steps
    assert [row[key] for key in ("backend", "size", "batch", "views")] == [name, 32, 2, 2]
    assert 0 < row["share"] < 1
    assert 0 < row["rasterizer_ms"] < row["step_ms"]
