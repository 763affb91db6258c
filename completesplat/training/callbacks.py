"""What happens around training."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn

from completesplat.training.latent_diffusion import LatentDiffusion


class ExponentialMovingAverage(WeightAveraging):
    """Average of the weights over the steps; checkpoints, validation and the end of training use the average.

    Lightning's own `EMAWeightAveraging` computes decay * a + (1 - decay) * b, which lets frozen weights and measured
    buffers drift by rounding; linear interpolation leaves them exactly as they are.

    Args:
        decay: weight of the past (not stated by the paper).
    """

    def __init__(self, decay: float) -> None:
        super().__init__(multi_avg_fn=get_ema_multi_avg_fn(decay))

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


class ExportWeights(Callback):
    """At the end of stage 2, write the generator as safetensors, for `predict` and `from_pretrained`."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, LatentDiffusion)
        if trainer.is_global_zero:
            pl_module.completesplat.save_pretrained(self.folder)
