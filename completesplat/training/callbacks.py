"""What happens around training."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer

from completesplat.training.latent_diffusion import LatentDiffusion


class ExportWeights(Callback):
    """At the end of stage 2, write the generator as safetensors, for `predict` and `from_pretrained`."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, LatentDiffusion)
        if trainer.is_global_zero:
            pl_module.completesplat.save_pretrained(self.folder)
