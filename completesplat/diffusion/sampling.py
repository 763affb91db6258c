"""Drawing latents: a denoiser, a diffusers scheduler, nothing else."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.diffusion.guidance import Denoise, guided_noise


class Sampler:
    """Reverse diffusion with one of diffusers' schedulers.

    Args:
        scheduler: e.g. `diffusers.DDIMScheduler`; its settings also define the forward process in training.
        steps: denoising steps unless a call says otherwise (50 in the paper).
    """

    def __init__(self, scheduler: Any, steps: int = 50) -> None:
        self.scheduler = scheduler
        self.steps = steps

    @torch.no_grad()
    def __call__(
        self,
        denoise: Denoise,
        noise: Float[Tensor, "batch channel height width"],
        conditioning: Float[Tensor, "batch features height width"],
        guidance_weight: float = 0.0,
        steps: int | None = None,
    ) -> Float[Tensor, "batch channel height width"]:
        """Denoise pure noise to latents (paper, Section 3.4). The result depends on the noise alone."""
        scheduler = self.scheduler
        scheduler.set_timesteps(steps or self.steps, device=noise.device)
        latent = noise * scheduler.init_noise_sigma
        for timestep in scheduler.timesteps:
            batched = timestep.expand(len(noise))
            inputs = scheduler.scale_model_input(latent, timestep)
            predicted = guided_noise(denoise, inputs, batched, conditioning, guidance_weight)
            latent = scheduler.step(predicted, timestep, latent).prev_sample
        return latent

    def add_noise(
        self, latent: Float[Tensor, "batch channel height width"], noise: Tensor, timestep: Tensor
    ) -> Float[Tensor, "batch channel height width"]:
        """The forward process h_t = sqrt(alpha_bar_t) h + sqrt(1 - alpha_bar_t) eps (paper, Eq. 2)."""
        return self.scheduler.add_noise(latent, noise, timestep)

    @property
    def training_timesteps(self) -> int:
        """T, the number of noise levels of the forward process."""
        return self.scheduler.config.num_train_timesteps
