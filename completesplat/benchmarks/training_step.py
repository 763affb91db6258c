"""Optimizer steps of both stages, and the rasterizer's share of a step of the reconstruction model."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from hydra.utils import instantiate
from torch import Tensor

from completesplat.benchmarks.measuring import Row
from completesplat.benchmarks.workloads import DISTANCE, Backend, orbit
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import CachedScene, SceneBatch, Views
from completesplat.training.stage import Stage

UNTIMED_STEPS, TIMED_STEPS = 3, 15
SLOW = {"gsplat_torch": (1, 3)}  # untimed and timed steps; the other slow backends would take minutes
MAXIMAL_NORM = 1.0  # of gradients, as in conf/trainer


class Training:
    """Optimizer steps of either stage as in a run, without its logging; `module` is on its device.

    `precision` is in Lightning's notation: "bf16-mixed" computes the networks in bfloat16.
    """

    def __init__(self, module: Stage, precision: str) -> None:
        self.module = module.train()
        self.precision = precision
        for logs in ("log_loss", "log_step"):  # there is no trainer to log with
            setattr(module, logs, lambda *_, **__: None)
        self.optimizer = module.optimizer([p for p in module.parameters() if p.requires_grad])

    def step(self, batch: SceneBatch | CachedScene) -> None:
        """Do one optimizer step on a batch of scenes or of their latents."""
        module = self.module
        with autocast(module.device, self.precision):
            loss: Tensor = module.training_step(batch.to(module.device), 0)  # type: ignore[assignment]
        self.optimizer.zero_grad()
        torch.autograd.backward([loss])
        torch.nn.utils.clip_grad_norm_(module.parameters(), MAXIMAL_NORM)
        self.optimizer.step()


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Return the context in which Lightning computes with this precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision.startswith("bf16"))


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


class _OnBackward(torch.autograd.Function):
    """Identity that calls a function when the tensors' gradients pass in the backward pass."""

    @staticmethod
    def forward(ctx: Any, function: Callable[[], None], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.function = function
        ctx.set_materialize_grads(False)  # zeros for missing gradients would be extra work for the rasterizer
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.function()
        return None, *gradients


def share(backend: Backend, model: Mapping[str, object], size: int, batch: int, targets: int, precision: str) -> Row:
    """Return medians over optimizer steps on one synthetic batch, on the CPU.

    Args:
        model: config of the module, without its rasterizer.
        size: side of the images in pixels.
        batch, targets: number of scenes in a batch, and of target views of each.
        precision: precision in Lightning's notation.
    """
    watch, scenes = StopWatch(backend.rasterizer), synthetic_batch(size, batch, targets)
    training = Training(instantiate(model, rasterizer=watch, _convert_="all"), precision)
    untimed, timed = SLOW.get(backend.name, (UNTIMED_STEPS, TIMED_STEPS))
    steps, inside = [], []
    for _ in range(untimed + timed):
        watch.seconds, start = 0.0, time.perf_counter()
        training.step(scenes)
        steps.append(time.perf_counter() - start)
        inside.append(watch.seconds)
    return {
        "backend": backend.name,
        "size": size,
        "batch": batch,
        "views": 1 + targets,
        "step_ms": statistics.median(steps[untimed:]) * 1e3,
        "rasterizer_ms": statistics.median(inside[untimed:]) * 1e3,
        "share": statistics.median(a / b for a, b in zip(inside[untimed:], steps[untimed:], strict=True)),
    }


def synthetic_batch(size: int, batch: int, targets: int) -> SceneBatch:
    """Return views of noise from an orbit, because the content of images does not change the work of a step."""
    generator = torch.Generator().manual_seed(0)
    cameras = orbit(size, 1 + targets)[0]
    cameras = cameras.relative_to(cameras[0]).map(lambda tensor: tensor.expand(batch, *tensor.shape))
    images = torch.rand(batch, 1 + targets, 3, size, size, generator=generator)
    views = Views(images, cameras, torch.ones_like(images[:, :, :1]))
    depth_range = torch.tensor([0.5 * DISTANCE, 2 * DISTANCE]).expand(batch, 2)
    frames = torch.zeros(batch, dtype=torch.int64)
    return SceneBatch(views[:, 0], views[:, 1:], depth_range, views.masks[:, 0], frames, ("synthetic",) * batch)
