"""How far training is, for whoever watches."""

import logging

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from rich import get_console

logger = logging.getLogger(__name__)


class Progress(RichProgressBar):
    """Lightning's bar, with optimizer steps; where nobody watches (no terminal), a line after every validation."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict:
        """What stands behind the bar."""
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
        """Lightning's speaks of -2 epochs where there is no limit to them."""
        return f"Epoch {current_epoch}"


def _steps(trainer: Trainer) -> str:
    return f"{trainer.global_step}" + (f"/{trainer.max_steps}" if trainer.max_steps > 0 else "")
