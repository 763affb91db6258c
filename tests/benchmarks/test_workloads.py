"""The scenes that are timed, and the time and memory of one rendering."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rasterizer_scenes import render_with_gradients

from completesplat.benchmarks.rasterizers import OPACITIES, rendering_milliseconds, splatter_scene
from completesplat.evaluation import scorer
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import Rendering
from completesplat.rasterizers.kernels import runtime
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.training import steps
from completesplat.training.steps import FOV_DEGREES, peak_megabytes


@pytest.mark.parametrize("opacity", OPACITIES)
def test_the_workload_looks_like_a_splatter_image(opacity: str) -> None:
    size, image_size = 32, 24
    gaussians, _ = splatter_scene(size, 1, opacity)
    intrinsics = pinhole(FOV_DEGREES, image_size)[None, None]
    source = Cameras(torch.eye(4)[None, None], intrinsics, (image_size, image_size))
    alpha = ReferenceRasterizer()(gaussians, source).alpha
    assert gaussians.count == 2 * size * size
    assert alpha.min() > 0.5  # every pixel has its Gaussians
    if opacity == "initial":
        assert 0.1 <= gaussians.opacities.min() <= gaussians.opacities.max() < 0.31
    else:
        assert gaussians.opacities.max() > 0.9
        assert (alpha > 0.99).float().mean() > 0.5


needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system has no /proc")
FLOATS = 60 * 2**20 // 4  # 60 MB
CPU = torch.device("cpu")


def test_gradients_of_all_images_are_taken_for_all_parameters() -> None:
    inputs: list[Gaussians] = []

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        inputs.append(gaussians)
        return ReferenceRasterizer()(gaussians, cameras)

    gaussians, cameras = splatter_scene(6, 2, "trained")
    rendering_milliseconds(rasterizer, gaussians, cameras)
    ones = [torch.ones_like(image) for image in vars(ReferenceRasterizer()(gaussians, cameras)).values()]
    _, gradients = render_with_gradients(ReferenceRasterizer(), gaussians, cameras, ones)
    for name, tensor in vars(inputs[0]).items():
        assert tensor.grad.any(), name
        torch.testing.assert_close(tensor.grad, gradients[name])
    assert not any(tensor.requires_grad for tensor in vars(gaussians).values())


def test_the_first_figure_is_the_forward_pass_and_the_second_both(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(scorer, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def passes(seconds: float) -> None:
        now[0] += seconds

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        passes(2.0)
        color = gaussians.opacities.mean().expand(1, 1, 3, *cameras.image_size)
        color.register_hook(lambda _: passes(3.0))
        return Rendering(color, color[:, :, :1], color[:, :, :1])

    assert rendering_milliseconds(rasterizer, *splatter_scene(4, 1, "initial")) == (2000.0, 5000.0)


@needs_proc
def test_the_peak_is_the_memory_that_work_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Freed memory counts, and so does memory that the kernels would use again."""
    arrays = [np.ones(FLOATS, np.float32)]  # memory from before does not count
    assert peak_megabytes(lambda: None, CPU) < 5
    assert 50 < peak_megabytes(lambda: np.ones(FLOATS, np.float32), CPU) < 70
    assert all(peak_megabytes(lambda: runtime.empty((FLOATS,)).fill(1), CPU) > 50 for _ in range(2))
    assert 50 < peak_megabytes(lambda: arrays.append(np.ones(FLOATS, np.float32)), CPU) < 70


def test_without_proc_the_work_is_done_and_its_memory_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(steps, "Path", lambda _: tmp_path / "nowhere/clear_refs")
    calls = []
    assert peak_megabytes(lambda: calls.append(1), CPU) is None
    assert calls == [1]
