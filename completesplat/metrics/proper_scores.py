"""Proper scores of samples: only the true distribution minimises them, so adding noise does not help.

Best of k rewards any spread. The energy score and the CRPS are strictly proper (Gneiting and Raftery 2007). The fair
forms here (Ferro 2014) are unbiased in the number of samples, so results with different numbers compare. For K equally
probable modes at mutual distance D, draws from the truth score (1 - 1/K) D / 2, the modes' mean scores
sqrt((K - 1) / 2K) D, and one mode drawn every time scores (1 - 1/K) D.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.tensors import as_float64

SampledValues = Float[Tensor, "sample value"]
TrueValues = Float[Tensor, " value"]


def energy_score(samples: SampledValues, truth: TrueValues) -> float:
    """Return E |x - y| - E |x - x'| / 2 for samples x, x' and truth y. Distances are root mean squares of values."""
    samples = as_float64(samples)
    truth = as_float64(truth)
    count, size = samples.shape
    spread = torch.pdist(samples).sum() * 2 / (count * (count - 1))
    error = torch.linalg.vector_norm(samples - truth, dim=1).mean()
    return float((error - spread / 2) / size**0.5)


def crps(samples: SampledValues, truth: TrueValues) -> float:
    """Return the continuous ranked probability score of each single value, averaged over the values."""
    samples = as_float64(samples)
    truth = as_float64(truth)
    count = len(samples)
    # The sum of |x - x'| over all pairs, from the sorted values.
    weights = 2 * torch.arange(count, device=samples.device) - count + 1
    pairs = (samples.sort(0).values * weights[:, None]).sum(0) / (count * (count - 1))
    return float(((samples - truth).abs().mean(0) - pairs).mean())


def rank_histogram(samples: SampledValues, truth: TrueValues) -> Float[Tensor, " rank"]:
    """Return the shares of values whose truth exceeds 0, 1, ... samples, flat if both have one distribution.

    A truth that equals some samples counts in equal parts for all ranks that it could have.
    """
    ranks = torch.arange(len(samples) + 1, device=samples.device)[:, None]
    below = (samples < truth).sum(0)
    equal = (samples == truth).sum(0)
    return as_float64(((ranks >= below) & (ranks <= below + equal)) / (equal + 1)).mean(1)
