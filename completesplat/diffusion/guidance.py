"""Guidance in the paper's sense: the weight w mixes the unconditional prediction in, which adds diversity."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from completesplat.errors import CompleteSplatError

Latents = Float[Tensor, "batch channel height width"]
Features = Float[Tensor, "batch feature height width"]
Denoise = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(noisy latent, timestep, conditioning) -> predicted noise."""


def check_guidance_weight(weight: float) -> None:
    """Refuse a weight outside of [0, 1], which is no share of the unconditional prediction (`CompleteSplatError`)."""
    if not 0 <= weight <= 1:
        raise CompleteSplatError(f"guidance_weight={weight:g}: must lie between 0 and 1")


def guided_noise(
    denoise: Denoise, noisy_latent: Latents, timestep: Int[Tensor, " batch"], conditioning: Features, weight: float
) -> Latents:
    """eps = (1 - w) * eps_conditional + w * eps_unconditional, with w in [0, 1].

    The customary guidance scale is s = 1 - w. The unconditional prediction is made with the conditioning zeroed, as it
    is with probability 0.2 in training. w = 0 and w = 1 cost one denoiser call, anything between one of twice the
    batch. `CompleteSplatError`: w outside of [0, 1].
    """
    check_guidance_weight(weight)
    if weight == 0:
        return denoise(noisy_latent, timestep, conditioning)
    nothing = torch.zeros_like(conditioning)
    if weight == 1:
        return denoise(noisy_latent, timestep, nothing)
    both = denoise(noisy_latent.repeat(2, 1, 1, 1), timestep.repeat(2), torch.cat([conditioning, nothing]))
    conditional, unconditional = both.chunk(2)
    return (1 - weight) * conditional + weight * unconditional
