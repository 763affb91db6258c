"""Scores that nobody improves by adding noise, and that only the true distribution minimises.

Best of k rewards spread of any kind. The energy score and the CRPS are strictly proper (Gneiting and Raftery 2007); the
fair forms here (Ferro 2014) are unbiased in the number of samples, so that results with different numbers compare. Of
K equally probable forms at mutual distance D, draws of the truth score (1 - 1/K) D / 2, their mean
sqrt((K - 1) / 2K) D, and one of them always (1 - 1/K) D.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def energy_score(samples: Float[Tensor, "sample value"], truth: Float[Tensor, " value"]) -> float:
    """E |x - y| - E |x - x'| / 2 for two samples x, x', with distances as root mean squares over the values."""
    count, size = samples.shape
    spread = torch.pdist(samples.double()).sum() * 2 / (count * (count - 1))
    error = torch.linalg.vector_norm(samples.double() - truth.double(), dim=1).mean()
    return float((error - spread / 2) / size**0.5)


def crps(samples: Float[Tensor, "sample value"], truth: Float[Tensor, " value"]) -> float:
    """Continuous ranked probability score of each value by itself, averaged over the values."""
    count = len(samples)
    # The sum of |x - x'| over all pairs, from the values in order.
    weights = 2 * torch.arange(count, device=samples.device) - count + 1
    pairs = (samples.double().sort(0).values * weights[:, None]).sum(0) / (count * (count - 1))
    return float(((samples.double() - truth.double()).abs().mean(0) - pairs).mean())


def rank_histogram(samples: Float[Tensor, "sample value"], truth: Float[Tensor, " value"]) -> Float[Tensor, " rank"]:
    """Shares of values whose truth has 0, 1, ... of the samples below it: flat if they are of one distribution.

    A truth that equals some samples is shared among the ranks that it could have.
    """
    ranks = torch.arange(len(samples) + 1, device=samples.device)[:, None]
    below = (samples < truth).sum(0)
    equal = (samples == truth).sum(0)
    return (((ranks >= below) & (ranks <= below + equal)) / (equal + 1)).double().mean(1)
