"""Several samples of one scene: the best of them, and how different they are."""

from collections.abc import Sequence
from itertools import combinations
from math import comb, isnan

import torch
from jaxtyping import Float
from torch import Tensor


def best(scores: Sequence[float], higher_is_better: bool = True) -> int:
    """The index of the best sample, the first of equals.

    Raises:
        ValueError: there is no score, or one is no number.
    """
    _check(scores)
    return scores.index(max(scores) if higher_is_better else min(scores))


def expected_best_curve(scores: Sequence[float], higher_is_better: bool = True) -> list[float]:
    """Entry j - 1 is the mean, over all choices of j of the k samples, of the best score among the j.

    Of k scores from worst to best, the i-th is the best of C(i - 1, j - 1) of the C(k, j) choices. The first entry is
    the mean of all scores, the last the best one.

    Raises:
        ValueError: there is no score, or one is no number.
    """
    _check(scores)
    k = len(scores)
    worst_first = sorted(scores, reverse=not higher_is_better)
    return [sum(comb(i, j) * score for i, score in enumerate(worst_first)) / comb(k, j + 1) for j in range(k)]


def _check(scores: Sequence[float]) -> None:
    if not scores or any(isnan(score) for score in scores):
        raise ValueError(f"needs scores that are numbers, not {list(scores)}")


def diversity(images: Float[Tensor, "sample view 3 height width"]) -> float:
    """Root mean square difference of two samples' renders, mean over all pairs of samples and all views.

    Raises:
        ValueError: less than two samples.
    """
    if len(images) < 2:
        raise ValueError("needs two samples")
    differences = [(one - other).square().mean((1, 2, 3)).sqrt() for one, other in combinations(images, 2)]
    return torch.stack(differences).mean().item()
