"""What the denoiser learns to predict; the scheduler's `prediction_type` decides, in training as in sampling."""

from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from completesplat.errors import CompleteSplatError

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")


def target(
    scheduler: Any,
    latent: Float[Tensor, "batch channel height width"],
    noise: Float[Tensor, "batch channel height width"],
    timestep: Int[Tensor, " batch"],
) -> Float[Tensor, "batch channel height width"]:
    """The right answer for h_t = sqrt(alpha_bar_t) h + sqrt(1 - alpha_bar_t) eps.

    `epsilon` is eps (paper, Eq. 3), `sample` is h, and `v_prediction` sqrt(alpha_bar_t) eps - sqrt(1 - alpha_bar_t) h
    (Salimans and Ho 2022, Section 4).

    Raises:
        CompleteSplatError: the scheduler predicts something else.
    """
    kind = scheduler.config.prediction_type
    if kind == "epsilon":
        return noise
    if kind == "sample":
        return latent
    if kind == "v_prediction":
        alpha_bar = scheduler.alphas_cumprod.to(latent)[timestep][:, None, None, None]
        return alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * latent
    raise CompleteSplatError(
        f"sampler.scheduler.prediction_type={kind}: cannot be trained; choose one of {', '.join(PREDICTION_TYPES)}"
    )
