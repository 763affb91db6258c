"""The best of several samples and their diversity, by brute force."""

from itertools import combinations

import pytest
import torch

from completesplat.metrics.sample_scores import best_sample, diversity, expected_best_curve

SCORES = [21.5, 19.0, 24.25, 19.0, 22.75, -3.0]


@pytest.mark.parametrize(("higher_is_better", "chosen"), [(True, max), (False, min)])
def test_the_curve_is_the_mean_best_of_all_choices(higher_is_better, chosen):
    among = [[chosen(choice) for choice in combinations(SCORES, j)] for j in range(1, len(SCORES) + 1)]
    expected = [sum(best) / len(best) for best in among]
    assert expected_best_curve(SCORES, higher_is_better) == pytest.approx(expected, rel=1e-12)


def test_the_best_is_the_first_of_equals():
    assert best_sample(SCORES) == 2
    assert best_sample(SCORES, higher_is_better=False) == 5
    assert best_sample([1.0, 3.0, 3.0]) == 1
    assert best_sample([3.0, 1.0, 1.0], higher_is_better=False) == 1


@pytest.mark.parametrize("scores", [[], [1.0, float("nan")]])
@pytest.mark.parametrize("function", [best_sample, expected_best_curve])
def test_without_numbers_nothing_is_best(function, scores):
    with pytest.raises(ValueError, match="scores that are numbers"):
        function(scores)


def test_diversity_is_the_mean_difference_of_all_pairs():
    images = torch.tensor([0.1, 0.2, 0.5]).view(3, 1, 1, 1, 1).expand(3, 2, 3, 4, 4)
    assert diversity(images) == pytest.approx((0.1 + 0.4 + 0.3) / 3)
