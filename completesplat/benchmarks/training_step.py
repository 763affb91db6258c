"""Optimizer steps of both stages."""

import torch
from torch import Tensor

from completesplat.scene import CachedScene, SceneBatch
from completesplat.training.stage import Stage

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
