"""Optimizer steps of both stages, and the rasterizer's share of a step of the reconstruction model."""

import statistics
from collections.abc import Mapping
from functools import cached_property

import torch
from hydra.utils import instantiate
from torch import Tensor
from torch.optim import Optimizer

from completesplat.benchmarks.measuring import Row, milliseconds
from completesplat.benchmarks.workloads import DISTANCE, Backend, orbit, rendering_milliseconds
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering
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
        self.module = module
        self.precision = precision
        for logs in ("log_loss", "log_step"):  # there is no trainer to log with
            setattr(module, logs, lambda *_, **__: None)

    @cached_property
    def optimizer(self) -> Optimizer:
        """Return the optimizer, which takes memory from the first step on."""
        return self.module.optimizer([p for p in self.module.parameters() if p.requires_grad])

    def step(self, batch: SceneBatch | CachedScene) -> None:
        """Do one optimizer step on a batch of scenes or of their latents."""
        module = self.module.train()
        with autocast(module.device, self.precision):
            loss: Tensor = module.training_step(batch.to(module.device), 0)  # type: ignore[assignment]
        self.optimizer.zero_grad()
        torch.autograd.backward([loss])
        torch.nn.utils.clip_grad_norm_(module.parameters(), MAXIMAL_NORM)
        self.optimizer.step()


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Return the context in which Lightning computes with this precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision.startswith("bf16"))


def share(backend: Backend, model: Mapping[str, object], size: int, batch: int, targets: int, precision: str) -> Row:
    """Return medians over optimizer steps on one synthetic batch, on the CPU.

    The rasterizer's part is the time of both its passes for the Gaussians and cameras of the last step.

    Args:
        model: config of the module, without its rasterizer.
        size: side of the images in pixels.
        batch, targets: number of scenes in a batch, and of target views of each.
        precision: precision in Lightning's notation.
    """
    inputs: list[tuple[Gaussians, Cameras]] = []

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        inputs[:] = [(gaussians, cameras)]
        return backend.rasterizer(gaussians, cameras)

    scenes = synthetic_batch(size, batch, targets)
    training = Training(instantiate(model, rasterizer=rasterizer, _convert_="all"), precision)
    untimed, timed = SLOW.get(backend.name, (UNTIMED_STEPS, TIMED_STEPS))
    steps = [milliseconds(lambda: training.step(scenes)) for _ in range(untimed + timed)]
    step = statistics.median(steps[untimed:])
    rendering = statistics.median(rendering_milliseconds(backend.rasterizer, *inputs[0])[1] for _ in range(timed))
    return {
        "backend": backend.name,
        "size": size,
        "batch": batch,
        "views": 1 + targets,
        "step_ms": step,
        "rasterizer_ms": rendering,
        "share": rendering / step,
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
