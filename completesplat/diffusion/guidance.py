"""The paper's two controls of sampling, guidance and skip weight, and the values that they may have.

Guidance has the paper's meaning: a weight w mixes in the unconditional prediction, for diversity; skips carry
visible content.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from completesplat.diffusion.denoiser import Conditioning, Denoise, Latents
from completesplat.errors import CompleteSplatError


def allowed_skip_weight(given: float | None, visible: Tensor | None = None) -> float:
    """Return the given weight, or by default 1, or 0 if part of an image is hidden (`visible` below 1).

    Raises:
        CompleteSplatError: the weight lies outside of [0, 1], or is above 0 although something is hidden.
    """
    hidden = visible is not None and bool((visible < 1).any())
    if given is None:
        return 0.0 if hidden else 1.0
    check_weight("skip_weight", given)
    if hidden and given > 0:
        reason = "skips carry its pixels into the scene"
        raise CompleteSplatError(f"skip_weight={given:g}: must be 0 where the image is hidden, as {reason}")
    return given


def check_weight(name: str, weight: float) -> None:
    """Raise CompleteSplatError if a weight lies outside of [0, 1]."""
    if not 0 <= weight <= 1:
        raise CompleteSplatError(f"{name}={weight:g}: must lie between 0 and 1")


def guided_noise(
    denoise: Denoise, noisy_latent: Latents, timestep: Int[Tensor, " batch"], conditioning: Conditioning, weight: float
) -> Latents:
    """Return eps = (1 - w) * eps_conditional + w * eps_unconditional, with w in [0, 1].

    The customary guidance scale is s = 1 - w. The unconditional prediction has its conditioning zeroed, as in
    training with probability 0.2. w = 0 and w = 1 cost one denoiser call. Other weights cost one of twice the batch.

    Raises:
        CompleteSplatError: w lies outside of [0, 1].
    """
    check_weight("guidance_weight", weight)
    if weight == 0:
        return denoise(noisy_latent, timestep, conditioning)
    nothing = torch.zeros_like(conditioning)
    if weight == 1:
        return denoise(noisy_latent, timestep, nothing)
    both = denoise(noisy_latent.repeat(2, 1, 1, 1), timestep.repeat(2), torch.cat([conditioning, nothing]))
    conditional, unconditional = both.chunk(2)
    return (1 - weight) * conditional + weight * unconditional


def in_bfloat16(denoise: Denoise, *inputs: Tensor) -> Latents:
    """Call a denoiser whose matrix products and convolutions are computed in bfloat16."""
    with torch.autocast(inputs[0].device.type, torch.bfloat16):
        return denoise(*inputs)
