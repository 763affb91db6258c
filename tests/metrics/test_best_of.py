"""The oracle among samples against brute force."""

from itertools import combinations

import pytest

from completesplat.metrics.scoring import best, expected_best_curve

SCORES = [21.5, 19.0, 24.25, 19.0, 22.75, -3.0]


@pytest.mark.parametrize(("higher_is_better", "chosen"), [(True, max), (False, min)])
def test_the_curve_is_the_mean_best_of_all_choices(higher_is_better, chosen):
    expected = []
    for j in range(1, len(SCORES) + 1):
        among = [chosen(choice) for choice in combinations(SCORES, j)]
        expected.append(sum(among) / len(among))
    assert expected_best_curve(SCORES, higher_is_better) == pytest.approx(expected, rel=1e-12)


def test_the_best_is_the_first_of_equals():
    assert best(SCORES) == 2
    assert best(SCORES, higher_is_better=False) == 5
    assert best([1.0, 3.0, 3.0]) == 1
    assert best([3.0, 1.0, 1.0], higher_is_better=False) == 1


@pytest.mark.parametrize("scores", [[], [1.0, float("nan")]])
@pytest.mark.parametrize("function", [best, expected_best_curve])
def test_without_numbers_nothing_is_best(function, scores):
    with pytest.raises(ValueError, match="scores that are numbers"):
        function(scores)
