"""Box masks: rectangles of stated sizes and number, in a stated share of the pictures."""

import numpy as np
import pytest
import torch
from torch import Tensor

from completesplat.data.loading.augmentation import BoxMasks
from completesplat.errors import CompleteSplatError


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def is_box(hidden: Tensor) -> bool:
    rows, columns = hidden.any(dim=1), hidden.any(dim=0)
    return bool(torch.equal(hidden, rows[:, None] & columns) and all(consecutive(line) for line in (rows, columns)))


def consecutive(line: Tensor) -> bool:
    places = line.nonzero()[:, 0]
    return int(places[-1] - places[0]) + 1 == len(places)


def test_a_single_box_is_a_rectangle_with_sides_in_the_stated_range() -> None:
    heights, widths, corners = set(), set(), set()
    for seed in range(300):
        visible = BoxMasks(1.0, boxes=(1, 1), sides=(0.25, 0.5))(16, 40, rng(seed))
        assert visible.shape == (1, 16, 40)
        hidden = visible[0] == 0
        assert is_box(hidden)
        heights.add(int(hidden.any(dim=1).sum()))
        widths.add(int(hidden.any(dim=0).sum()))
        corners |= {name for name, pixel in {"first": hidden[0, 0], "last": hidden[-1, -1]}.items() if pixel}
    assert heights == set(range(4, 9))
    assert widths == set(range(10, 21))
    assert corners == {"first", "last"}


def test_several_boxes_hide_no_more_than_all_of_them_together() -> None:
    hidden = [(BoxMasks(1.0, boxes=(2, 3), sides=(0.2, 0.2))(40, 40, rng(seed)) == 0).sum() for seed in range(200)]
    assert max(hidden) == 3 * 8 * 8
    # Two boxes may overlap, but hide at least one.
    assert min(hidden) >= 8 * 8
    assert 2 * 8 * 8 in hidden


def test_pictures_are_masked_with_the_stated_probability() -> None:
    """Of 1000 draws, 4 standard deviations to either side."""
    for probability in (0.5, 0.2):
        masked = sum(bool((BoxMasks(probability)(8, 8, rng(seed)) == 0).any()) for seed in range(1000))
        assert abs(masked - 1000 * probability) < 4 * (1000 * probability * (1 - probability)) ** 0.5
    assert all((BoxMasks(0.0)(8, 8, rng(seed)) == 1).all() for seed in range(50))


def test_a_visible_map_is_one_or_zero() -> None:
    assert set(BoxMasks(1.0)(32, 32, rng()).unique().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize(
    "settings",
    [
        {"probability": 1.5},
        {"probability": float("nan")},
        {"boxes": (0, 2)},
        {"boxes": (3, 2)},
        {"boxes": (3,)},
        {"sides": (0.0, 0.5)},
        {"sides": (0.5, 0.2)},
        {"sides": (0.5, 1.2)},
    ],
)
def test_settings_of_boxes_without_meaning_are_refused_by_name(settings: dict[str, object]) -> None:
    with pytest.raises(CompleteSplatError, match=next(iter(settings))):
        BoxMasks(**settings)
