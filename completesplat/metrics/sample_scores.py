"""Scores of several samples of one scene: the best of k, and how much the samples differ."""

from collections.abc import Sequence
from itertools import combinations
from math import comb, isnan

import torch
from jaxtyping import Float
from torch import Tensor

SampledViews = Float[Tensor, "sample view 3 height width"]


def best_sample(scores: Sequence[float], higher_is_better: bool = True) -> int:
    """Return the index of the best score, or raise ValueError as `expected_best_curve` does."""
    return scores.index(_worst_first(scores, higher_is_better)[-1])


def expected_best_curve(scores: Sequence[float], higher_is_better: bool = True) -> list[float]:
    """Return a list whose entry j - 1 is the mean, over all choices of j of the k samples, of the best score.

    Of k scores from worst to best, the i-th is the best of C(i - 1, j - 1) of the C(k, j) choices.

    Raises:
        ValueError: there are no scores, or one is not a number.
    """
    worst_first = _worst_first(scores, higher_is_better)
    k = len(scores)
    return [sum(comb(i, j) * score for i, score in enumerate(worst_first)) / comb(k, j + 1) for j in range(k)]


def _worst_first(scores: Sequence[float], higher_is_better: bool) -> list[float]:
    if not scores or any(isnan(score) for score in scores):
        raise ValueError(f"needs scores that are numbers, not {list(scores)}")
    return sorted(scores, reverse=not higher_is_better)


def noisy_mean(images: SampledViews, seed: int) -> SampledViews:
    """Return as many images: the samples' mean plus white noise of the same variance as the samples.

    Best of k gains from this noise too, so a gain of that size does not speak for the samples.
    """
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed)).to(images)
    return (images.mean(0) + images.var(0).mean().sqrt() * noise).clamp(0, 1)


def diversity(images: SampledViews) -> float:
    """Return the root mean square difference of two samples' renders, averaged over all pairs and views."""
    differences = [(a - b).square().mean((1, 2, 3)).sqrt() for a, b in combinations(images, 2)]
    return torch.stack(differences).mean().item()
