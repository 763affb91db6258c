"""Stage 2: latent diffusion over the frozen autoreconstructor's latents (paper, Section 3.3)."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.diffusion.latents import measure_scale
from completesplat.errors import WeightsError
from completesplat.gaussians import Gaussians
from completesplat.generation import CompleteSplat
from completesplat.scene import SceneBatch
from completesplat.training.checkpoints import load_part
from completesplat.training.scene_module import SceneModule


class LatentDiffusion(SceneModule):
    """Train the denoiser and a learned conditioning to predict the noise in latents (paper, Eqs. 2 and 3).

    Args:
        completesplat: the whole generator, its autoreconstructor still without weights.
        autoreconstructor_checkpoint: a checkpoint of stage 1, needed to train.
        unconditional_probability: how often phi_ref is zeroed, for guidance (0.2 in the paper).
        skip_weight, guidance_weight: settings of the samples drawn in validation and test.
        scale_batches: training batches on which the latents' scale is measured.
        **rendering_and_optimization: see `SceneModule`.
    """

    def __init__(
        self,
        completesplat: CompleteSplat,
        autoreconstructor_checkpoint: str | None = None,
        unconditional_probability: float = 0.2,
        skip_weight: float = 1.0,
        guidance_weight: float = 0.0,
        scale_batches: int = 50,
        **rendering_and_optimization: Any,
    ) -> None:
        super().__init__(**rendering_and_optimization)
        self.completesplat = completesplat
        self.autoreconstructor_checkpoint = autoreconstructor_checkpoint
        self.unconditional_probability = unconditional_probability
        self.skip_weight = skip_weight
        self.guidance_weight = guidance_weight
        self.scale_batches = scale_batches
        if autoreconstructor_checkpoint is not None:
            load_part(completesplat.autoreconstructor, autoreconstructor_checkpoint, prefix="model.")

    def on_fit_start(self) -> None:
        """Measure what the training set alone tells: the latents' scale, and the camera of a typical photograph."""
        if self.autoreconstructor_checkpoint is None:
            raise WeightsError("stage 2 needs stage 1: give model.autoreconstructor_checkpoint=FILE")
        parts = self.completesplat
        if parts.latent_scale != 1:  # a resumed run keeps what it measured
            return
        data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        loader = data.train_dataloader()
        batches = (scenes.reference.images for _, scenes in zip(range(self.scale_batches), loader, strict=False))
        scale = measure_scale(lambda images: parts.encode(images.to(self.device)).latent, batches)
        parts.latent_scale.fill_(scale)
        camera = data.typical_camera()
        parts.fov_degrees.fill_(camera.fov_degrees)
        parts.depth_range.copy_(torch.tensor(camera.depth_range))
        parts.up.copy_(torch.tensor(camera.up))

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        parts = self.completesplat
        images = scenes.reference.images
        latent = parts.encode(images).latent
        conditioning = parts.conditioning(images * scenes.visible)
        kept = torch.rand(len(images), device=self.device) >= self.unconditional_probability
        conditioning = conditioning * kept[:, None, None, None]
        noise = torch.randn_like(latent)
        timestep = torch.randint(parts.sampler.training_timesteps, (len(images),), device=self.device)
        predicted = parts.denoiser(parts.sampler.add_noise(latent, noise, timestep), timestep, conditioning)
        loss = torch.nn.functional.mse_loss(predicted, noise)
        self.log("train/loss", loss.detach(), batch_size=len(images))
        return loss

    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """One sample for each reference image."""
        return self.completesplat.generate(
            scenes.reference.images,
            scenes.reference.cameras,
            scenes.depth_range,
            skip_weight=self.skip_weight,
            guidance_weight=self.guidance_weight,
            seed=seed,
        )
