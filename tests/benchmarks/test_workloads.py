"""The scenes that are timed, and the time and memory of one rendering."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rasterizer_scenes import render_with_gradients

from completesplat.benchmarks import workloads
from completesplat.benchmarks.workloads import (
    OPACITIES,
    rendering_milliseconds,
    splatter_scene,
)
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import Rendering, RenderingConstants
from completesplat.rasterizers.kernels import drawing
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.training import stage, steps
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
    monkeypatch.setattr(stage, "time", SimpleNamespace(perf_counter=lambda: now[0]))

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
    assert all(peak_megabytes(lambda: drawing.empty((FLOATS,)).fill(1), CPU) > 50 for _ in range(2))
    assert 50 < peak_megabytes(lambda: arrays.append(np.ones(FLOATS, np.float32)), CPU) < 70


def test_without_proc_the_work_is_done_and_its_memory_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(steps, "Path", lambda _: tmp_path / "nowhere/clear_refs")
    calls = []
    assert peak_megabytes(lambda: calls.append(1), CPU) is None
    assert calls == [1]


def test_counted_work_is_that_of_a_count_by_hand() -> None:
    """Of three large opaque Gaussians two use up the light; a small one is before them, one behind the camera."""
    size, views = 8, 2  # four blocks, so two bands of block rows in each of two views

    def rows(*values: float) -> torch.Tensor:
        return torch.tensor([values])

    gaussians = Gaussians(
        means=torch.tensor([[[0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.0, 4.0], [0.5, 0.5, 1.0], [0.0, 0.0, -1.0]]]),
        quaternions=rows(1.0, 0, 0, 0).expand(1, 5, 4),
        scales=rows(50.0, 50, 50, 0.001, 1)[..., None].expand(1, 5, 3),
        opacities=rows(1.0, 1, 1, 0.5, 1),
        colors=torch.full((1, 5, 3), 0.5),
    )
    intrinsics = torch.tensor([[4.0, 0, 4], [0, 4, 4], [0, 0, 1]]).expand(1, views, 3, 3)
    cameras = Cameras(torch.eye(4).expand(1, views, 4, 4), intrinsics, (size, size))
    flops, moved = workloads.counted_work(gaussians, cameras, RenderingConstants())
    # In each view: one block with the small Gaussian, and four with each of the first two large ones. The third is
    # visible but reaches no pixel. The large ones reach both bands.
    drawn, visible, reached = views * (1 + 4 + 4), views * 4, views * (1 + 2 * 2)
    assert flops == 16 * drawn * (26 + 50) + 2 * 136 * visible + 2 * 352 * reached
    assert moved == 5 * (212 + views * (68 + 2 * 8)) + 448 * visible + 180 * reached


def test_the_peaks_are_those_of_a_product_and_a_copy(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([4.0, 2.0, 3.0, 5.0, 6.0, 0.5, 0.25, 1.0, 2.0, 3.0])
    monkeypatch.setattr(workloads, "milliseconds", lambda work: (work(), next(times))[1])
    monkeypatch.setattr(workloads, "PEAK_SIDE", 10)
    monkeypatch.setattr(workloads, "PEAK_COPY", 100)
    assert workloads.machine_peaks() == (2000 / 2.0, 800 / 0.25)
