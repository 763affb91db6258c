"""Mode coverage and calibration of samples, for scenes in which every possible mode is known."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

Samples = Float[Tensor, "sample pixel 3"]
Modes = Float[Tensor, "mode pixel 3"]
Probabilities = Float[Tensor, " mode"]
PerPixel = Float[Tensor, "*view height width"]
REJECTED = -1
# Variances of colours in [0, 1]: one bin below a standard deviation of 0.001, then two bins in each decade.
EDGES = torch.tensor([1e-6 * 10 ** (i / 2) for i in range(11)], dtype=torch.float64)


@dataclass(frozen=True)
class HiddenModeScores:
    """Scores of one scene's samples, or their means over scenes.

    `coverage`: share of the modes (of positive probability) that at least one sample belongs to. `total_variation`:
    half the sum of absolute differences between the samples' shares and the modes' probabilities. Rejected samples are
    a class of probability 0, so 1 is the worst. A perfect sampler with few samples does not reach 0, so compare with
    draws from the true distribution. `sharpness`: mean distance of a sample to its nearest mode, divided by that of
    the modes' mean to its nearest mode (0: exactly modes). `rejected`: share of rejected samples.
    """

    coverage: float
    total_variation: float
    sharpness: float
    rejected: float


def distances(samples: Samples, modes: Modes) -> Float[Tensor, "sample mode"]:
    """Return the root mean square difference of every sample and every mode."""
    return torch.stack([(samples - mode).square().mean((1, 2)).sqrt() for mode in modes], dim=1)


def classify(samples: Samples, modes: Modes, probabilities: Probabilities) -> Int64[Tensor, " sample"]:
    """Return the mode of each sample, or `REJECTED` if it is not near enough to one.

    Raises:
        ValueError: fewer than two modes, equal modes, or no pixels.
    """
    if len(modes) < 2 or not modes.shape[1]:
        raise ValueError("needs two modes and a pixel")
    between = distances(modes, modes).fill_diagonal_(torch.inf)
    if not between.min() > 0:
        raise ValueError("two modes are equal")
    nearest, mode = distances(samples, modes).min(dim=1)
    from_mean = distances(samples, mean_of(modes, probabilities)[None])[:, 0]
    accepted = (nearest < between.min() / 2) & (nearest < from_mean)
    return mode.where(accepted, torch.full_like(mode, REJECTED))


def mean_of(
    modes: Float[Tensor, "mode *picture _"], probabilities: Float[Tensor, " mode"]
) -> Float[Tensor, "*picture _"]:
    """Return the modes' mean, weighted by their probabilities."""
    mean: Tensor = torch.tensordot(probabilities, modes, dims=1)
    return mean


def scores(samples: Samples, modes: Modes, probabilities: Probabilities) -> HiddenModeScores:
    """Score one scene; samples and modes are the region's pixels of all views in one row."""
    if not len(samples):
        raise ValueError("needs a sample")
    classes = classify(samples, modes, probabilities)
    shares = torch.stack([(classes == mode).float().mean() for mode in range(len(modes))])
    rejected = (classes == REJECTED).float().mean()
    possible = probabilities > 0
    from_mean = distances(mean_of(modes, probabilities)[None], modes).min()
    return HiddenModeScores(
        coverage=(shares[possible] > 0).float().mean().item(),
        total_variation=0.5 * ((shares - probabilities).abs().sum() + rejected).item(),
        sharpness=(distances(samples, modes).min(dim=1).values.mean() / from_mean).item(),
        rejected=rejected.item(),
    )


def mean_scores(of_scenes: Sequence[HiddenModeScores]) -> HiddenModeScores:
    """Average the scores of at least one scene; every scene has the same weight."""
    means = (sum(values) / len(of_scenes) for values in zip(*map(astuple, of_scenes), strict=True))
    return HiddenModeScores(*means)


def draw_modes(
    modes: Float[Tensor, "mode *picture _"], probabilities: Float[Tensor, " mode"], samples: int, seed: int
) -> Float[Tensor, "sample *picture _"]:
    """Draw modes by their probabilities, as a perfect model would."""
    generator = torch.Generator().manual_seed(seed)
    return modes[torch.multinomial(probabilities.cpu(), samples, replacement=True, generator=generator)]


def spread_and_error(
    samples: Float[Tensor, "sample *view 3 height width"], truth: Float[Tensor, "*view 3 height width"]
) -> tuple[PerPixel, PerPixel]:
    """Return the samples' variance (unbiased) and the squared error of their mean, averaged over the channels."""
    if len(samples) < 2:
        raise ValueError("needs two samples")
    return samples.var(dim=0).mean(-3), (samples.mean(dim=0) - truth).square().mean(-3)


def bin_sums(
    variance: PerPixel, squared_error: PerPixel, region: Bool[Tensor, "*view height width"]
) -> Float[Tensor, "bin 3"]:
    """Return number of pixels, sum of variances and sum of squared errors of the region's pixels, by bin of variance.

    Sums of several scenes may be added. The bins are bounded by `EDGES`, open at both ends.
    """
    variances, errors = variance[region].double().cpu(), squared_error[region].double().cpu()
    places = torch.bucketize(variances, EDGES, right=True)
    values = torch.stack([torch.ones_like(variances), variances, errors], dim=1)
    return torch.zeros(len(EDGES) + 1, 3, dtype=torch.float64).index_add_(0, places, values)


def curve(sums: Float[Tensor, "bin 3"]) -> dict[str, Any]:
    """Return the means over all pixels and over those of each non-empty bin; None if there are no pixels at all."""
    count, variance, error = sums.sum(0).tolist()
    return {
        "pixels": int(count),
        "variance": variance / count if count else None,
        "squared_error": error / count if count else None,
        "bins": [{"pixels": int(n), "variance": v / n, "squared_error": e / n} for n, v, e in sums.tolist() if n > 0],
    }
