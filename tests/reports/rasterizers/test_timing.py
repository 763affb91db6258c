"""Time and memory of one rendering: what is counted, and what is not."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from completesplat.benchmarks import workloads
from completesplat.benchmarks.workloads import milliseconds, peak_megabytes, splatter_scene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering
from completesplat.rasterizers.kernels import drawing
from completesplat.rasterizers.reference import ReferenceRasterizer

needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system has no /proc")
FLOATS = 60 * 2**20 // 4  # 60 MB


def test_gradients_of_all_images_are_taken_for_all_parameters() -> None:
    given: list[Gaussians] = []

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        given.append(gaussians)
        return ReferenceRasterizer()(gaussians, cameras)

    gaussians, cameras = splatter_scene(6, 2, "trained")
    milliseconds(rasterizer, gaussians, cameras)
    leaves = gaussians.map(lambda tensor: tensor.clone().requires_grad_())
    rendering = ReferenceRasterizer()(leaves, cameras)
    (rendering.color.sum() + rendering.depth.sum() + rendering.alpha.sum()).backward()
    for name, leaf in vars(leaves).items():
        found = getattr(given[0], name).grad
        assert found.any(), name
        torch.testing.assert_close(found, leaf.grad)
    assert not any(tensor.requires_grad for tensor in vars(gaussians).values())


def test_the_first_figure_is_the_forward_pass_and_the_second_both(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(workloads, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    class Image(torch.autograd.Function):
        @staticmethod
        def forward(ctx, opacities, shape):
            now[0] += 2.0
            ctx.shape = opacities.shape
            return opacities.new_zeros(shape)

        @staticmethod
        def backward(ctx, gradient):
            now[0] += 3.0
            return gradient.new_zeros(ctx.shape), None

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        height, width = cameras.image_size
        color = Image.apply(gaussians.opacities, (1, 1, 3, height, width))
        return Rendering(color, color[:, :, :1], color[:, :, :1])

    assert milliseconds(rasterizer, *splatter_scene(4, 1, "initial")) == (2000.0, 5000.0)


def peak(work: Callable[[], object]) -> float:
    found = peak_megabytes(work, "cpu")
    assert found is not None
    return found


@needs_proc
def test_memory_that_is_given_back_before_the_end_counts() -> None:
    def work() -> None:
        array = np.ones(FLOATS, np.float32)
        time.sleep(0.05)  # many samples
        del array

    assert 50 < peak(work) < 70


@needs_proc
def test_memory_that_is_held_at_the_end_counts_however_short_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workloads, "SAMPLING_SECONDS", 1e3)
    kept = []
    assert 50 < peak(lambda: kept.append(np.ones(FLOATS, np.float32))) < 70


@needs_proc
def test_no_work_needs_next_to_no_memory() -> None:
    kept = np.ones(FLOATS, np.float32)  # what was there before does not count
    assert peak(lambda: None) < 5
    assert kept.all()


@needs_proc
def test_memory_that_the_kernels_would_use_again_counts_each_time() -> None:
    def work() -> None:
        drawing.Buffers().empty((FLOATS,)).fill(1)

    assert all(peak(work) > 50 for _ in range(2))


def test_without_proc_the_work_is_done_and_memory_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(workloads, "Path", lambda _: tmp_path / "statm")
    done = []
    assert peak_megabytes(lambda: done.append(1), "cpu") is None
    assert done == [1]


def test_an_error_in_the_work_comes_through_and_leaves_no_thread() -> None:
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError):
        peak_megabytes(lambda: 1 / 0, "cpu")
    assert threading.active_count() == before
