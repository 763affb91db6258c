"""Stage 1: a reconstruction model trained from posed images alone (paper, Section 3.2)."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.losses import Prediction, WeightedSum
from completesplat.scene import SceneBatch
from completesplat.training.checkpoints import load_part
from completesplat.training.scene_module import SceneModule, prepare_network


class ReconstructionModule(SceneModule):
    """Reconstruct, render the reference and all targets, compare (paper, Eq. 1).

    Args:
        model: images -> `Reconstruction`: the Variational AutoReconstructor or a baseline.
        loss: weighted terms by name.
        checkpoint: of an earlier stage, whose weights this one starts from.
        masked: the model sees the visible part of the reference picture only (`data.box_masks`), and is to complete it;
            it is compared with whole pictures. The paper leaves this as future work.
        channels_last, compile: see `prepare_network`.
        **rendering_and_optimization: see `SceneModule`.
    """

    def __init__(
        self,
        model: nn.Module,
        loss: WeightedSum,
        checkpoint: str | None = None,
        masked: bool = False,
        channels_last: bool = False,
        compile: bool = False,
        **rendering_and_optimization: Any,
    ) -> None:
        super().__init__(**rendering_and_optimization)
        self.model = model
        self.loss = loss
        self.masked = masked
        if checkpoint is not None:
            load_part(model, checkpoint, prefix="model.")
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        prepare_network(model, channels_last, compile)

    def on_fit_start(self) -> None:
        """Refuse a latent cache: this stage trains what would encode it."""
        if getattr(self.trainer.datamodule, "latent_cache", None) is not None:  # type: ignore[attr-defined]
            raise CompleteSplatError(
                "data.latent_cache is for latent diffusion (model=latent_diffusion): set it to null"
            )

    @property
    def method(self) -> str:
        """The reconstruction model's class."""
        return type(self.model).__name__

    def forward(self, scenes: SceneBatch) -> Reconstruction:
        """Splatter Images, and posteriors if the model has any, from the reference images alone."""
        images = scenes.reference.images * scenes.visible if self.masked else scenes.reference.images
        reconstruction: Reconstruction = self.model(images.contiguous(memory_format=self.memory_format))
        return reconstruction

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        reconstruction = self(scenes)
        with torch.autocast(self.device.type, enabled=False):
            gaussians = reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
            prediction = Prediction(self.render(gaussians, scenes), gaussians, reconstruction.posterior)
            total, values = self.loss(prediction, scenes.all_views(), self.global_step)
        logged = {f"train/{name}": value for name, value in values.items()}
        self.log_dict({"train/loss": total.detach(), **logged}, batch_size=len(scenes.names))
        return total

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Gaussians from the posterior's mode: nothing is drawn, so the seed has no effect."""
        reconstruction: Reconstruction = self(scenes)
        return reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
