"""Stage 1: a reconstruction model trained from posed images alone (paper, Section 3.2)."""

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.baselines.autodecoder import AutoDecoder, Codes, optimize_codes
from completesplat.baselines.splatter_image.model import PublishedSplatterImage, write_trained
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.evaluation.scorer import Scorer
from completesplat.gaussians import Gaussians
from completesplat.generator import DeterministicModel
from completesplat.losses import Prediction, WeightedSum
from completesplat.metrics.images import psnr
from completesplat.scene import Batch, SceneBatch, Views
from completesplat.splatter_image import SplatterImage
from completesplat.training.stage import Compile, Stage, prepare_network
from completesplat.weights import CAMERA
from completesplat.weights.checkpoint_reading import load_part
from completesplat.weights.opening import camera_tensors

logger = logging.getLogger(__name__)


class ReconstructionScorer(Scorer):
    """Scorer of a model of one pass, from an image to its scene.

    Args:
        model: images -> `Reconstruction`.
        **rendering: see `Scorer`.
    """

    def __init__(self, model: nn.Module, **rendering: Any) -> None:
        super().__init__(**rendering)
        self.model = model

    @property
    def method(self) -> str:
        return type(self.model).__name__

    def forward(self, scenes: SceneBatch) -> Reconstruction:
        """Return Splatter Images, and posteriors if the model has any."""
        return self.model(scenes.reference.images)

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return Gaussians from the posterior's mode. Nothing is drawn, so the seed has no effect."""
        reconstruction: Reconstruction = self(scenes)
        return reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)


class ReconstructionModule(ReconstructionScorer, Stage):
    """Reconstruct, render the reference and all targets, compare (paper, Eq. 1).

    Args:
        model: images -> `Reconstruction`: the Variational AutoReconstructor or a baseline.
        loss: weighted terms by name.
        checkpoint: checkpoint of an earlier stage, whose weights this one starts from.
        masked: the model sees only the visible part of the reference image (`data.box_masks`) and learns to complete
            it. Renders are compared with whole images. The paper leaves this as future work.
        channels_last, compile: see `prepare_network`.
        **rendering_and_optimization: see `Stage`.
    """

    def __init__(
        self,
        model: nn.Module,
        loss: WeightedSum,
        checkpoint: str | None = None,
        masked: bool = False,
        channels_last: bool = False,
        compile: Compile = False,
        **rendering_and_optimization: Any,
    ) -> None:
        super().__init__(model, **rendering_and_optimization)
        self.loss = loss
        self.masked = masked
        self.camera: dict[str, float | list[float]] = {}
        if checkpoint is not None:
            load_part(model, checkpoint, prefix="model.")
        self.memory_format = prepare_network(model, channels_last, compile)

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Return the direction up in the reference camera's frame, as measured on the training set."""
        return torch.tensor(self.camera["up"]) if self.camera else super().up

    def save_weights(self, folder: Path) -> None:
        """Write the network with the typical camera.

        Published weights are written in the format of their authors. A network that weights may not name is left out,
        with a warning.
        """
        if isinstance(self.model, PublishedSplatterImage):
            return write_trained(folder, self.model.file, self.model.state_dict())
        assert self.config is not None
        trained = {f"network.{name}": tensor for name, tensor in self.model.state_dict().items()}
        try:
            model = DeterministicModel(self.config["model"]["model"], self.data.image_size)
            model.load_state_dict(trained | camera_tensors(self.camera))
        except WeightsError as error:
            logger.warning("no weights are written to %s: %s", folder, error)
            return
        model.architecture["training"] = self.data.training_facts()
        model.save_pretrained(folder)

    def on_fit_start(self) -> None:
        """Measure the camera of a typical photo, for photos of unknown cameras (`DeterministicModel`).

        Raises:
            CompleteSplatError: there is a latent cache, which is for stage 2, the posterior gets too few views, or
                published weights get images of another size.
        """
        if self.trainer.datamodule is None:  # type: ignore[attr-defined]  # plain batches, which have no data set
            return
        data = self.data
        if self.sees_views and data.targets < 2:
            raise CompleteSplatError("posterior=views needs targets to see and to predict: data.targets of 2 or more")
        if data.latent_cache is not None:
            raise CompleteSplatError("data.latent_cache is for model=latent_diffusion: set it to null")
        if isinstance(self.model, PublishedSplatterImage) and data.image_size != self.model.image_size:
            message = f"{self.model.file.name} needs {self.model.image_size}"
            raise CompleteSplatError(f"data.image_size={data.image_size}: {message}")
        self.camera = {name: torch.tensor(value).tolist() for name, value in data.typical_camera()._asdict().items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the training set's typical camera."""
        super().on_save_checkpoint(checkpoint)
        checkpoint[CAMERA] = self.camera

    @property
    def sees_views(self) -> bool:
        """Whether the model has a posterior that sees other views than the reference."""
        return getattr(self.model, "sees_views", False)

    def latent_figures(self, scenes: SceneBatch) -> dict[str, float]:
        """Return the latent's KL to the prior per scene: `latent/bits`, and `latent/bits_0`, ... for each channel.

        `latent/active_channels` counts the active channels (`completesplat.autoreconstructor.posterior`).
        """
        posterior = self(scenes).posterior
        if posterior is None or not getattr(self.model, "variational", True):  # its variance is not trained
            return {}
        bits = posterior.channel_bits().tolist()
        channels = {f"latent/bits_{index}": value for index, value in enumerate(bits)}
        return {"latent/bits": sum(bits), "latent/active_channels": float(posterior.active_channels()), **channels}

    def forward(self, scenes: SceneBatch, others: int = 0) -> Reconstruction:
        """Return Splatter Images, and posteriors if the model has any.

        Args:
            others: number of targets that the posterior sees besides the reference image.
        """
        images = scenes.reference.images
        if self.masked:
            images = images * scenes.visible
        images = images.contiguous(memory_format=self.memory_format)
        if others == 0:
            return self.model(images)
        return self.model(images, scenes.all_views()[:, : 1 + others], scenes.depth_range)

    def draw_others(self, targets: int) -> int:
        """Draw how many of the targets a posterior that sees views gets: mostly many, never all."""
        return int(torch.randint(1, targets, (2,)).max())

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        others = self.draw_others(scenes.targets.images.shape[1]) if self.sees_views else 0
        total, figures = self.losses(scenes, others)
        self.log_step({f"train/{name}": value for name, value in figures.items()}, batch_size=len(scenes.names))
        return total

    def losses(self, scenes: SceneBatch, others: int) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """Return the loss of all views and figures of it, where the posterior sees a number of the targets."""
        reconstruction = self(scenes, others)
        with torch.autocast(self.device.type, enabled=False):
            gaussians = reconstruction.splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
            truth = scenes.all_views()
            images = self.rasterizer(gaussians, truth.cameras).over(self.background)
            prediction = Prediction(images, gaussians, reconstruction.posterior)
            total, values = self.loss(prediction, truth, self.global_step)
            images = images.detach().clamp(0, 1)
            quality = psnr(images.flatten(0, 1), truth.images.flatten(0, 1)).mean()
        return total, {"loss": total.detach(), "psnr": quality, **values}

    @torch.no_grad()
    def predicts_finite(self, batch: Batch) -> bool:
        """Return whether most Gaussians of the batch's first scene are finite."""
        assert isinstance(batch, SceneBatch)
        finite = self.reconstruct(batch[:1]).finite()
        return finite.float().mean().item() > 0.5

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        """Score the reference image alone, and if the posterior sees views, also with every other target encoded.

        `val/loss` is the loss of training, where such a posterior sees the first half of the targets.
        `val/psnr_posterior` scores the targets between, which the posterior has not seen: the best that stage 2 could
        reach. `val/posterior_gain` is its gain over the reference image alone for these targets.
        """
        super().validation_step(scenes, index)
        total, _ = self.losses(scenes, scenes.targets.images.shape[1] // 2 if self.sees_views else 0)
        self.log("val/loss", total, batch_size=len(scenes.names))
        if not self.sees_views or scenes.targets.images.shape[1] < 2:
            return
        encoded = replace(scenes, targets=scenes.targets[:, ::2])
        between = replace(scenes, targets=scenes.targets[:, 1::2])
        splatter_image = self(encoded, encoded.targets.images.shape[1]).splatter_image
        gaussians = splatter_image.gaussians(scenes.reference.cameras, scenes.depth_range)
        values = self.novel_psnr(gaussians, between)
        gain = values - self.novel_psnr(self.reconstruct(scenes), between)
        figures = {"val/psnr_posterior": values.mean(), "val/posterior_gain": gain.mean()}
        self.log_dict(figures, prog_bar=True, batch_size=len(values))


class ReconstructorOnly(ReconstructionModule):
    """Reconstructor whose image codes are optimised (supplement, "Reconstructor-only without the Encoder").

    Codes and reconstructor are trained jointly. A test image gets a new code for the fixed reconstructor.

    Args:
        loss: weighted terms by name. Training uses all views, the test the reference alone.
        code_steps, code_rate: steps and learning rate of a new code's optimisation (800 and 0.005 in DeepSDF).
    """

    model: AutoDecoder

    def __init__(self, model: AutoDecoder, loss: WeightedSum, code_steps: int, code_rate: float, **others: Any) -> None:
        super().__init__(model, loss, **others)
        self.code_steps = code_steps
        self.code_rate = code_rate

    def latent_figures(self, scenes: SceneBatch) -> dict[str, float]:
        """Return no figures, because a code has no posterior, and a scene's takes a fit."""
        return {}

    def setup(self, stage: str) -> None:
        """Allocate a code for each training image, unless a checkpoint has codes."""
        super().setup(stage)
        if stage == "fit" and not len(self.model.codes):
            source = self.data.source("train")
            frames = 0
            for name in source.names:
                with suppress(DataError):
                    frames += len(source.read(name).frames)
            self.model.make_room(frames)

    def on_fit_start(self) -> None:
        """Raise CompleteSplatError for averages, and for several processes, which would assign codes differently."""
        super().on_fit_start()
        self.refuse_average()
        if self.trainer.world_size > 1:
            raise CompleteSplatError("model=reconstructor_only trains in one process: set trainer.devices=1")

    def save_weights(self, folder: Path) -> None:
        """Write no weights, because a new photo has no code."""

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        """Score novel views alone, because each look at a scene takes a fit."""
        Stage.validation_step(self, scenes, index)

    def forward(self, scenes: SceneBatch, others: int = 0) -> Reconstruction:
        """Reconstruct training images from their codes, and in evaluation any image from a new code."""
        if self.training:
            codes = self.model.codes_of(scenes.names, scenes.reference_frame)
        else:
            codes = self.infer_codes(scenes, seed=0)
        return Reconstruction(self.model(codes), None)

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return Gaussians of new codes that are optimised for the reference view from seeded initial values."""
        return self.gaussians(self.infer_codes(scenes, seed), scenes)

    def infer_codes(self, scenes: SceneBatch, seed: int) -> Codes:
        """Optimise new codes for the reference views alone, at fixed weights."""
        with torch.inference_mode(False), torch.autocast(self.device.type, enabled=False):
            # Autograd cannot use tensors that were made in inference mode, but it can use copies.
            scenes = scenes.map(torch.clone)
            codes = self.model.new_codes(len(scenes.names), seed)
            return optimize_codes(codes, lambda x: self.reference_loss(x, scenes), self.code_steps, self.code_rate)

    def gaussians(self, codes: Codes, scenes: SceneBatch) -> Gaussians:
        image: SplatterImage = self.model(codes)
        return image.gaussians(scenes.reference.cameras, scenes.depth_range)

    def reference_loss(self, codes: Codes, scenes: SceneBatch) -> Float[Tensor, ""]:
        """Return the loss of the reference views alone, with the terms of the current training step."""
        views: Views = scenes.reference.map(lambda tensor: tensor[:, None])
        gaussians = self.gaussians(codes, scenes)
        images = self.rasterizer(gaussians, views.cameras).over(self.background)
        total, _ = self.loss(Prediction(images, gaussians, None), views, self.global_step)
        return total
