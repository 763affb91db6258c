"""What a training step draws depends on the seed and its place in the run only."""

from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer


class StepSeeds(Callback):
    """Seeds torch's global generators anew before every training batch.

    Posterior noise, skip dropout and the noise of the diffusion then depend on (seed, epoch, batch, process) alone, not
    on what was drawn before: a run that is resumed, in the middle of an epoch too, draws what it would have drawn.
    Batches are counted, not optimizer steps, which several batches share where gradients are accumulated.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        torch.manual_seed(step_seed(self.seed, trainer.current_epoch, batch_idx, trainer.global_rank))


def step_seed(*place: int) -> int:
    """64 bits that are different and unrelated for different places (NumPy's `SeedSequence`)."""
    return int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0])
