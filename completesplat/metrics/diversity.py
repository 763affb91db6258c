"""How different the samples of one scene are from each other."""

from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor


def diversity(images: Float[Tensor, "sample view 3 height width"]) -> float:
    """Root mean square difference of two samples' renders, mean over all pairs of samples and all views.

    Raises:
        ValueError: less than two samples.
    """
    if len(images) < 2:
        raise ValueError("needs two samples")
    differences = [(one - other).square().mean((1, 2, 3)).sqrt() for one, other in combinations(images, 2)]
    return torch.stack(differences).mean().item()
