"""Callbacks of training: seeds of each step, averaged weights, the progress bar, and the weights that are exported."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar, WeightAveraging
from rich import get_console
from torch.optim.swa_utils import get_ema_multi_avg_fn

from completesplat.training.latent_diffusion import LatentDiffusion

logger = logging.getLogger(__name__)


class StepSeeds(Callback):
    """Seeds torch's global generators anew before every training batch.

    What is drawn then depends on (seed, epoch, batch, process) alone: a run that is resumed, in the middle of an epoch
    too, draws what it would have drawn. (Several batches share an optimizer step where gradients are accumulated.)
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        torch.manual_seed(step_seed(self.seed, trainer.current_epoch, batch_idx, trainer.global_rank))


def step_seed(*place: int) -> int:
    """64 bits that are different and unrelated for different places (NumPy's `SeedSequence`)."""
    return int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0])


class ExponentialMovingAverage(WeightAveraging):
    """Average of the weights over the steps; checkpoints, validation and the end of training use the average.

    Lightning's own `EMAWeightAveraging` computes decay * a + (1 - decay) * b, which lets frozen weights and measured
    buffers drift by rounding; linear interpolation leaves them exactly as they are. The paper states no `decay`.
    """

    def __init__(self, decay: float) -> None:
        averages: Callable[[float], Any] = get_ema_multi_avg_fn
        super().__init__(multi_avg_fn=averages(decay))

    @contextmanager
    def in_place(self, module: LightningModule) -> Iterator[None]:
        """The average in the place of the weights, as in validation."""
        self._swap_models(module)
        try:
            yield
        finally:
            self._swap_models(module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Not yet: the checkpoint that is written now must hold the weights too, for a run that goes on."""

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_end(trainer, pl_module)


class Progress(RichProgressBar):
    """Lightning's bar, with optimizer steps; where nobody watches (no terminal), a line after every validation."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """The figures behind the bar."""
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        return {"step": _steps(trainer), **metrics}

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_validation_end(trainer, pl_module)
        if get_console().is_terminal or not trainer.is_global_zero:
            return
        shown = {k: v for k, v in trainer.callback_metrics.items() if k == "train/loss" or k.startswith("val/")}
        logger.info("step %s: %s", _steps(trainer), ", ".join(f"{k} {v:.4g}" for k, v in shown.items()))

    def _get_train_description(self, current_epoch: int) -> str:
        return f"Epoch {current_epoch}"  # Lightning's speaks of -2 epochs where there is no limit to them


def _steps(trainer: Trainer) -> str:
    return f"{trainer.global_step}" + (f"/{trainer.max_steps}" if trainer.max_steps > 0 else "")


class ExportWeights(Callback):
    """At the end of stage 2, write the generator as safetensors, for `predict` and `from_pretrained`."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, LatentDiffusion)
        if trainer.is_global_zero:
            pl_module.completesplat.save_pretrained(self.folder)
