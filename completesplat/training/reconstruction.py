"""Stage 1: a reconstruction model trained from posed images alone (paper, Section 3.2)."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.losses import Prediction, WeightedSum
from completesplat.metrics.images import psnr
from completesplat.scene import SceneBatch
from completesplat.training.stage import Stage, prepare_network
from completesplat.weights import CAMERA
from completesplat.weights.checkpoint_reading import load_part


class ReconstructionModule(Stage):
    """Reconstruct, render the reference and all targets, compare (paper, Eq. 1).

    Args:
        model: images -> `Reconstruction`: the Variational AutoReconstructor or a baseline.
        loss: weighted terms by name.
        checkpoint: of an earlier stage, whose weights this one starts from.
        masked: the model sees the visible part of the reference picture only (`data.box_masks`), and is to complete it;
            it is compared with whole pictures. The paper leaves this as future work.
        channels_last, compile: see `prepare_network`.
        **rendering_and_optimization: see `Stage`.
    """

    networks = ("model",)

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
        """Refuse a latent cache, since this stage trains what would encode it, and too few views for the posterior.

        The camera of a typical photograph is measured for those whose camera is not known (`OneAnswer`).
        """
        data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        if self.sees_views and data.targets < 2:
            raise CompleteSplatError(
                "posterior=views needs targets to see and others to predict: data.targets of 2 or more"
            )
        if getattr(data, "latent_cache", None) is not None:
            raise CompleteSplatError(
                "data.latent_cache is for latent diffusion (model=latent_diffusion): set it to null"
            )
        measured = {} if data is None else data.typical_camera()._asdict()  # a benchmark trains on one batch
        self.camera = {name: torch.tensor(value).tolist() for name, value in measured.items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the training set's typical camera."""
        super().on_save_checkpoint(checkpoint)
        checkpoint[CAMERA] = self.camera

    @property
    def method(self) -> str:
        """The reconstruction model's class."""
        return type(self.model).__name__

    @property
    def sees_views(self) -> bool:
        """Whether the model's posterior sees other views than the reference; baselines have none."""
        return getattr(self.model, "sees_views", False)

    def forward(self, scenes: SceneBatch, others: int = 0) -> Reconstruction:
        """Splatter Images, and posteriors if the model has any.

        Args:
            others: so many of the targets are seen by the posterior besides the reference picture.
        """
        images = scenes.reference.images * scenes.visible if self.masked else scenes.reference.images
        images = images.contiguous(memory_format=self.memory_format)
        seen = (scenes.all_views()[:, : 1 + others], scenes.depth_range) if others else ()
        reconstruction: Reconstruction = self.model(images, *seen)
        return reconstruction

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        """A posterior that sees views is given a random number of the targets, more often many than few, never all."""
        targets = scenes.targets.images.shape[1]
        others = int(torch.randint(1, targets, (2,)).max()) if self.sees_views else 0
        reconstruction = self(scenes, others)
        with torch.autocast(self.device.type, enabled=False):
            gaussians = reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
            prediction = Prediction(self.render(gaussians, scenes), gaussians, reconstruction.posterior)
            total, values = self.loss(prediction, scenes.all_views(), self.global_step)
            shown, truth = prediction.images.detach().clamp(0, 1), scenes.all_views().images
            quality = psnr(shown.flatten(0, 1), truth.flatten(0, 1)).mean()
        logged = {f"train/{name}": value for name, value in values.items()}
        self.log_step({"train/loss": total.detach(), "train/psnr": quality, **logged}, batch_size=len(scenes.names))
        return total

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        """From the reference picture alone; and, with a posterior that sees views, as that encodes every other target.

        The second, `val/psnr_posterior`, is of the targets between, which it has not seen: what a perfect stage 2 could
        reach. `val/posterior_gain` is how much more that is than the reference picture alone gives for these targets.
        """
        super().validation_step(scenes, index)
        if not self.sees_views or scenes.targets.images.shape[1] < 2:
            return
        seen = replace(scenes, targets=scenes.targets[:, ::2])
        others = replace(scenes, targets=scenes.targets[:, 1::2])
        splatter_image = self(seen, seen.targets.images.shape[1]).splatter_image
        gaussians = splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
        values = self.novel_psnr(gaussians, others)
        gain = values - self.novel_psnr(self.reconstruct(scenes), others)
        found = {"val/psnr_posterior": values.mean(), "val/posterior_gain": gain.mean()}
        self.log_dict(found, prog_bar=True, batch_size=len(values))

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Gaussians from the posterior's mode: nothing is drawn, so the seed has no effect."""
        reconstruction: Reconstruction = self(scenes)
        return reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
