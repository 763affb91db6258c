"""Gaussians that move and are added while a scene is fitted: 3DGS-MCMC (Kheradmand et al. 2024).

Unlike 3DGS, it needs no gradients of image positions, so any rasterizer serves.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.tensors import as_float64

DEAD_OPACITY = 0.005
MOST_COPIES = 51  # as in the authors' code and gsplat
NOISE = 5e5
NOISE_STEEPNESS = 100.0


def opacity_of_copies(opacities: Float[Tensor, " n"], copies: Int64[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the opacity of each of several equal Gaussians that together are as opaque as one (3DGS-MCMC, Eq. 9)."""
    return 1 - (1 - opacities) ** (1 / copies)


def scale_of_copies(opacities: Float[Tensor, " n"], copies: Int64[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the factor on the scales of the copies of `opacity_of_copies` (Eq. 9).

    It preserves the integral of alpha along a line. Their double sum is written as one sum, by C(0, k) + ... +
    C(n - 1, k) = C(n, k + 1).
    """
    alpha = as_float64(opacities)
    n = as_float64(copies)[:, None]
    o = opacity_of_copies(alpha, copies.to(alpha.device))[:, None]
    j = torch.arange(1, int(copies.max()) + 1, dtype=torch.float64, device=o.device)
    logarithm = torch.lgamma(n + 1) - torch.lgamma(j + 1) - torch.lgamma((n - j).clamp(min=0) + 1)
    terms = torch.where(j <= n, logarithm.exp() * o**j / j.sqrt(), 0) * (1 - 2 * ((j + 1) % 2))
    return (alpha / terms.sum(-1)).to(opacities)


@torch.no_grad()
def relocate(raw: Mapping[str, Tensor], count: int, new_count: int) -> Int64[Tensor, " changed"]:
    """Replace dead Gaussians, and fill rows `count` to `new_count`, by copies of living ones, drawn by opacity.

    Args:
        raw: tensors [row ...] of `RawGaussians` by name, which are changed.

    Returns:
        The rows that were changed, whose state in an optimizer is no longer true.
    """
    logits = raw["logits"]
    opacities = logits[:count].sigmoid()
    dead = opacities <= DEAD_OPACITY
    vacant = torch.cat([dead.nonzero()[:, 0], torch.arange(count, new_count, device=logits.device)])
    if len(vacant) == 0 or bool(dead.all()):
        return vacant[:0]
    sources = torch.multinomial(opacities.where(~dead, 0), len(vacant), replacement=True)
    copies = sources.bincount(minlength=count) + 1
    parents = (copies > 1).nonzero()[:, 0]
    number = copies[parents].clamp(max=MOST_COPIES)
    opacity = opacities[parents].clamp(max=1 - 1e-6)
    raw["log_scales"][parents] += scale_of_copies(opacity, number).log()[:, None]
    logits[parents] = opacity_of_copies(opacity, number).clamp(min=DEAD_OPACITY).logit()
    for tensor in raw.values():
        tensor[vacant] = tensor[sources]
    return torch.cat([parents, vacant])


def position_noise(gaussians: Gaussians, rate: float) -> Float[Tensor, "gaussian 3"]:
    """Draw noise that moves transparent Gaussians along their covariance (3DGS-MCMC, Eq. 8), for a positions' rate."""
    weights = torch.sigmoid(NOISE_STEEPNESS * (DEAD_OPACITY - gaussians.opacities)) * (NOISE * rate)
    noise = torch.randn_like(gaussians.means) * weights[:, None]
    return (gaussians.covariances() @ noise[..., None])[..., 0]
