"""Forward process and prediction target of the denoiser, as the scheduler's options define them.

A noisy latent is h_t = a h + b eps. Diffusion has a = sqrt(alpha_bar_t) and b = sqrt(1 - alpha_bar_t) (paper, Eq. 2),
flow matching a = 1 - t and b = t (Lipman et al. 2023; Liu et al. 2023, "rectified flow"). The denoiser predicts

- `epsilon`: eps (paper, Eq. 3)
- `sample`: h
- `v_prediction`: a eps - b h (Salimans and Ho 2022, Section 4)
- `flow`: eps - h, the velocity of flow matching
"""

from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers.configuration_utils import ConfigMixin
from jaxtyping import Float, Int
from torch import Tensor

from completesplat.diffusion.denoiser import Latents
from completesplat.errors import CompleteSplatError

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
"""Prediction types of diffusion; flow matching has only one."""


def signal_and_noise(
    scheduler: Any, timestep: Int[Tensor, "*batch"], like: Tensor
) -> tuple[Float[Tensor, "*batch 1 1 1"], Float[Tensor, "*batch 1 1 1"]]:
    """Return the factors a of the latent and b of the noise at a timestep, with the type and device of `like`."""
    if is_flow(scheduler):
        time = timestep.to(like)[..., None, None, None] / scheduler.config.num_train_timesteps
        return 1 - time, time
    alpha_bar: Tensor = scheduler.alphas_cumprod.to(like, non_blocking=True)[timestep][..., None, None, None]
    return alpha_bar.sqrt(), (1 - alpha_bar).sqrt()


def target(scheduler: ConfigMixin, latent: Latents, noise: Latents, timestep: Int[Tensor, " batch"]) -> Latents:
    """Return the true prediction for a latent and the noise added to it.

    Raises:
        CompleteSplatError: as `prediction_type`.
    """
    kind = prediction_type(scheduler)
    if kind == "v_prediction":
        signal_factor, noise_factor = signal_and_noise(scheduler, timestep, latent)
        return signal_factor * noise - noise_factor * latent
    return {"epsilon": noise, "sample": latent, "flow": noise - latent}[kind]


def clean_estimate(scheduler: ConfigMixin, noisy: Latents, predicted: Latents, timestep: Int[Tensor, ""]) -> Latents:
    """Return the clean latent h that a prediction implies.

    Raises:
        CompleteSplatError: as `prediction_type`.
    """
    kind = prediction_type(scheduler)
    signal_factor, noise_factor = signal_and_noise(scheduler, timestep, noisy)
    if kind == "epsilon":
        return (noisy - noise_factor * predicted) / signal_factor
    if kind == "v_prediction":
        return signal_factor * noisy - noise_factor * predicted
    return noisy - noise_factor * predicted if kind == "flow" else predicted


def is_flow(scheduler: object) -> bool:
    """Return whether a scheduler samples along the straight lines of flow matching."""
    return isinstance(scheduler, FlowMatchEulerDiscreteScheduler)


def prediction_type(scheduler: ConfigMixin) -> str:
    """Return one of `PREDICTION_TYPES`, or "flow".

    Raises:
        CompleteSplatError: the scheduler has another type.
    """
    if is_flow(scheduler):
        return "flow"
    kind: str = scheduler.config["prediction_type"]
    if kind not in PREDICTION_TYPES:
        raise CompleteSplatError(f"sampler.scheduler.prediction_type={kind}: choose from {', '.join(PREDICTION_TYPES)}")
    return kind
