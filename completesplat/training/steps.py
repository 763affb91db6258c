"""Optimizer steps outside of a trainer, on a synthetic batch, and the memory that work takes."""

import ctypes
import math
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from torch.optim import Optimizer

from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.scene import Batch, SceneBatch, Views
from completesplat.training.stage import Stage

DISTANCE = 2.2  # from the cameras to the object's centre, world units
FOV_DEGREES = 49.0
MEBIBYTE = 2**20
MAXIMAL_NORM = 1.0  # of gradients, as in conf/trainer


class Training:
    """Optimizer steps of either stage as in a run, without its logging.

    Args:
        precision: Lightning's name; "bf16-mixed" computes the networks in bfloat16.
    """

    def __init__(self, module: Stage, precision: str | int) -> None:
        self.module = module
        self.precision = str(precision)
        for logs in ("log_loss", "log_step"):  # there is no trainer to log with
            setattr(module, logs, lambda *_, **__: None)

    @cached_property
    def optimizer(self) -> Optimizer:
        """Return the optimizer, which takes memory from the first step on."""
        return self.module.optimizer([p for p in self.module.parameters() if p.requires_grad])

    def optimizer_bytes(self) -> int:
        """Return the bytes of the optimizer's state."""
        values = (value for state in self.optimizer.state.values() for value in state.values())
        return sum(value.nbytes for value in values if isinstance(value, Tensor))

    def step(self, *batches: Batch) -> None:
        """Accumulate the gradients of the batches, and change the weights."""
        for index, batch in enumerate(batches):
            loss = self.loss(batch) / len(batches)
            if index == 0:
                self.optimizer.zero_grad()  # after the forward pass, as Lightning does
            torch.autograd.backward([loss])
        self.update()

    def loss(self, batch: Batch) -> Tensor:
        module = self.module.train()
        dtype = torch.float16 if self.precision.startswith("16") else torch.bfloat16
        with torch.autocast(module.device.type, dtype, enabled=not self.precision.startswith("32")):
            loss: Tensor = module.training_step(batch.to(module.device), 0)  # type: ignore[assignment]
        return loss

    def update(self) -> None:
        """Clip the gradients and change the weights."""
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), MAXIMAL_NORM, foreach=True)
        self.optimizer.step()


def cameras_on_orbit(size: int, views: int) -> Cameras:
    """Return cameras [1 view] on an orbit about the object, for images of side `size`."""
    angles = 0.5 + 2 * math.pi * torch.arange(views) / views
    target = torch.tensor([0.0, 0.0, DISTANCE])
    eyes = target + DISTANCE * torch.stack([angles.sin(), torch.full_like(angles, -0.2), -angles.cos()], dim=-1)
    matrices = look_at(eyes, target, torch.tensor([0.0, -1.0, 0.0]))
    return Cameras(matrices[None], pinhole(FOV_DEGREES, size).expand(1, views, 3, 3), (size, size))


def synthetic_batch(size: int, batch: int, targets: int) -> SceneBatch:
    """Return views of noise from an orbit, because the content of images does not change the work of a step."""
    generator = torch.Generator().manual_seed(0)
    cameras = cameras_on_orbit(size, 1 + targets)[0]
    cameras = cameras.relative_to(cameras[0]).repeated(batch)
    images = torch.rand(batch, 1 + targets, 3, size, size, generator=generator)
    views = Views(images, cameras, torch.ones_like(images[:, :, :1]))
    depth_range = torch.tensor([0.5 * DISTANCE, 2 * DISTANCE]).expand(batch, 2)
    frames = torch.zeros(batch, dtype=torch.int64)
    return SceneBatch(views[:, 0], views[:, 1:], depth_range, views.masks[:, 0], frames, ("synthetic",) * batch)


def peak_megabytes(work: Callable[[], object], device: torch.device) -> float | None:
    """Return the memory in MB that `work` adds to the process, or to the GPU, or None if the system does not tell."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return (torch.cuda.max_memory_allocated() - before) / MEBIBYTE
    from completesplat.rasterizers.kernels.runtime import release  # imports numba

    # Return memory that the process still holds after freeing it, because reusing it would not be counted.
    release()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # a function of glibc
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak becomes the present memory
    except OSError:
        work()
        return None
    before = _peak_resident_kilobytes()
    work()
    return (_peak_resident_kilobytes() - before) / 1024


def _peak_resident_kilobytes() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
