"""Share of the rasterizer in a training step of the reconstruction model."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from completesplat.benchmarks.workloads import DISTANCE, Backend, orbit
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch, Views

UNTIMED_STEPS, TIMED_STEPS = 3, 15
SLOW = {"gsplat_torch": (1, 3)}  # untimed and timed steps; the other slow backends would take minutes


class StopWatch:
    """A rasterizer that sums the time of its forward and backward passes."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.rasterizer = rasterizer
        self.seconds = 0.0

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render with the rasterizer."""
        gaussians = Gaussians(*_OnBackward.apply(self._stop, *vars(gaussians).values()))  # type: ignore[no-untyped-call]
        self._start()
        rendering = self.rasterizer(gaussians, cameras)
        self._stop()
        return Rendering(*_OnBackward.apply(self._start, *vars(rendering).values()))  # type: ignore[no-untyped-call]

    def _start(self) -> None:
        self.seconds -= time.perf_counter()

    def _stop(self) -> None:
        self.seconds += time.perf_counter()


class Repeated(Dataset[Any]):
    """Data set of the same item, `count` times."""

    def __init__(self, item: Any, count: int) -> None:
        self.item, self.count = item, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Any:
        return self.item


class _OnBackward(torch.autograd.Function):
    """Identity that calls a function when the tensors' gradients pass in the backward pass."""

    @staticmethod
    def forward(ctx: Any, function: Callable[[], None], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.function = function
        ctx.set_materialize_grads(False)  # zeros for missing gradients would be extra work for the rasterizer
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        ctx.function()
        return None, *gradients


class _StepTimes(Callback):
    def __init__(self, watch: StopWatch) -> None:
        self.watch = watch
        self.steps: list[tuple[float, float]] = []  # seconds in total and in the rasterizer

    def on_train_batch_start(self, trainer: Trainer, module: LightningModule, batch: Any, index: int) -> None:
        self.started, self.watch.seconds = time.perf_counter(), 0.0

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs: Any, batch: Any, index: int
    ) -> None:
        self.steps.append((time.perf_counter() - self.started, self.watch.seconds))


def share(
    backend: Backend, make_module: Callable[[Rasterizer], LightningModule], size: int, batch: int, targets: int,
    precision: str,
) -> dict[str, Any]:  # fmt: skip
    """Return medians over optimizer steps on one synthetic batch, on the CPU.

    Args:
        make_module: makes the LightningModule with a rasterizer.
        size: side of the images in pixels.
        batch, targets: number of scenes in a batch, and of target views of each.
        precision: precision in Lightning's notation.
    """
    watch = StopWatch(backend.rasterizer)
    times = _StepTimes(watch)
    untimed, timed = SLOW.get(backend.name, (UNTIMED_STEPS, TIMED_STEPS))
    trainer = Trainer(
        max_steps=untimed + timed,
        precision=precision,  # type: ignore[arg-type]
        gradient_clip_val=1.0,
        accelerator="cpu",
        devices=1,
        callbacks=[times],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    batches = Repeated(synthetic_batch(size, batch, targets), untimed + timed)
    trainer.fit(make_module(watch), DataLoader(batches, batch_size=None))
    steps = times.steps[untimed:]
    return {
        "backend": backend.name,
        "size": size,
        "batch": batch,
        "views": 1 + targets,
        "step_ms": statistics.median(step for step, _ in steps) * 1e3,
        "rasterizer_ms": statistics.median(inside for _, inside in steps) * 1e3,
        "share": statistics.median(inside / step for step, inside in steps),
    }


def synthetic_batch(size: int, batch: int, targets: int) -> SceneBatch:
    """Return views of noise from an orbit, because the content of images does not change the work of a step."""
    generator = torch.Generator().manual_seed(0)
    cameras = orbit(size, 1 + targets)[0]
    cameras = cameras.relative_to(cameras[0]).map(lambda tensor: tensor.expand(batch, *tensor.shape))
    images = torch.rand(batch, 1 + targets, 3, size, size, generator=generator)
    views = Views(images, cameras, torch.ones_like(images[:, :, :1]))
    depth_range = torch.tensor([0.5 * DISTANCE, 2 * DISTANCE]).expand(batch, 2)
    names = tuple("synthetic" for _ in range(batch))
    frames = torch.zeros(batch, dtype=torch.int64)
    return SceneBatch(views[:, 0], views[:, 1:], depth_range, views.masks[:, 0], frames, names)
