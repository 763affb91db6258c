"""What the denoiser predicts; the scheduler's `prediction_type` decides, in training as in sampling.

In h_t = sqrt(alpha_bar_t) h + sqrt(1 - alpha_bar_t) eps (paper, Eq. 2), `epsilon` is eps (Eq. 3), `sample` is h, and
`v_prediction` sqrt(alpha_bar_t) eps - sqrt(1 - alpha_bar_t) h (Salimans and Ho 2022, Section 4).
"""

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
    """The right prediction for a latent and the noise that was added to it.

    Raises:
        CompleteSplatError: the scheduler predicts something else.
    """
    kind = prediction_type(scheduler)
    if kind == "epsilon":
        return noise
    if kind == "sample":
        return latent
    alpha_bar: Tensor = scheduler.alphas_cumprod.to(latent)[timestep].view(-1, 1, 1, 1)
    return alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * latent


def clean_estimate(
    scheduler: Any,
    noisy_latent: Float[Tensor, "batch channel height width"],
    predicted: Float[Tensor, "batch channel height width"],
    timestep: Int[Tensor, ""],
) -> Float[Tensor, "batch channel height width"]:
    """The latent h that a prediction stands for.

    Raises:
        CompleteSplatError: the scheduler predicts something else.
    """
    kind = prediction_type(scheduler)
    if kind == "sample":
        return predicted
    alpha_bar: Tensor = scheduler.alphas_cumprod.to(noisy_latent)[timestep]
    signal, noise = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
    if kind == "epsilon":
        return (noisy_latent - noise * predicted) / signal
    return signal * noisy_latent - noise * predicted


def prediction_type(scheduler: Any) -> str:
    """One of `PREDICTION_TYPES`.

    Raises:
        CompleteSplatError: the scheduler has another one.
    """
    kind: str = scheduler.config.prediction_type
    if kind not in PREDICTION_TYPES:
        raise CompleteSplatError(
            f"sampler.scheduler.prediction_type={kind}: unknown; choose one of {', '.join(PREDICTION_TYPES)}"
        )
    return kind
