"""Whether samples differ from each other where, and as much as, their mean is wrong.

If the truth is one more draw from the distribution of S samples, the squared error of their mean is (1 + 1/S) times
their variance, in expectation, whatever the variance: a bin of pixels lies on that line.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Of variances of colours in [0, 1]: all below a deviation of 0.001, then two bins in each decade.
EDGES = torch.tensor([1e-6 * 10 ** (i / 2) for i in range(11)], dtype=torch.float64)


def spread_and_error(
    samples: Float[Tensor, "sample *view 3 height width"], truth: Float[Tensor, "*view 3 height width"]
) -> tuple[Float[Tensor, "*view height width"], Float[Tensor, "*view height width"]]:
    """Variance over the samples (unbiased) and squared error of their mean, each a mean over the three channels.

    Raises:
        ValueError: fewer than two samples.
    """
    if len(samples) < 2:
        raise ValueError("needs two samples")
    return samples.var(dim=0).mean(-3), (samples.mean(dim=0) - truth).square().mean(-3)


def bin_sums(
    variance: Float[Tensor, "*view height width"],
    squared_error: Float[Tensor, "*view height width"],
    region: Bool[Tensor, "*view height width"],
) -> Float[Tensor, "bin 3"]:
    """Number of pixels, sum of variances and sum of squared errors of the region's pixels, by bin of variance.

    Sums of several scenes may be added. The bins are bounded by `EDGES`, open at both ends.
    """
    variances, errors = variance[region].double().cpu(), squared_error[region].double().cpu()
    places = torch.bucketize(variances, EDGES, right=True)
    values = torch.stack([torch.ones_like(variances), variances, errors], dim=1)
    return torch.zeros(len(EDGES) + 1, 3, dtype=torch.float64).index_add_(0, places, values)


def curve(sums: Float[Tensor, "bin 3"]) -> dict[str, Any]:
    """Means over all pixels and over those of each bin that has any; None where there are no pixels at all."""
    total = sums.sum(0)
    pixels = [row for row in sums.tolist() if row[0] > 0]
    return {
        "pixels": int(total[0]),
        "variance": _ratio(total[1], total[0]),
        "squared_error": _ratio(total[2], total[0]),
        "bins": [{"pixels": int(n), "variance": v / n, "squared_error": e / n} for n, v, e in pixels],
    }


def _ratio(value: Tensor, pixels: Tensor) -> float | None:
    return (value / pixels).item() if pixels > 0 else None
