"""Statistics of the latents on which the diffusion model is trained."""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor


@torch.no_grad()
def measure_scale(draw_latent: Callable[[Tensor], Tensor], images: Iterable[Float[Tensor, "_ 3 _ _"]]) -> float:
    """The factor that gives latents unit standard deviation over all elements, as Stable Diffusion's 0.18215 does.

    The paper does not say how its latents are scaled; the factor is measured and stored with the weights.

    Raises:
        ValueError: no images, or latents without any variation.
    """
    count, total, squares = 0, 0.0, 0.0
    for batch in images:
        latent = draw_latent(batch).double()
        count += latent.numel()
        total += latent.sum().item()
        squares += latent.square().sum().item()
    variance = squares / count - (total / count) ** 2 if count else 0.0
    if variance <= 0:
        raise ValueError("the latents do not vary: no images, or an encoder that ignores them")
    return variance**-0.5
