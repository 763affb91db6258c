"""The paper's two controls of a drawing, and what they may be: guidance and the weight of the skips.

Guidance in the paper's sense: the weight w mixes the unconditional prediction in, which adds diversity. Skips carry
what the picture shows into the scene.
"""

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


def allowed_skip_weight(given: float | None, visible: Tensor | None = None) -> float:
    """The weight that is given, else 1, or 0 where something of a picture is hidden (`visible` below 1).

    Raises:
        CompleteSplatError: a weight outside of [0, 1], or one above 0 with something hidden.
    """
    if given is not None and not 0 <= given <= 1:
        raise CompleteSplatError(f"skip_weight={given:g}: must lie between 0 and 1")
    hidden = visible is not None and bool((visible < 1).any())
    if hidden and given:
        raise CompleteSplatError(
            f"skip_weight={given:g}: must be 0 where the picture is hidden, as skips carry its pixels into the scene"
        )
    return (0.0 if hidden else 1.0) if given is None else given


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
