"""Which frames are drawn, and that a draw depends on nothing but seed, epoch and index."""

import numpy as np
import pytest

from completesplat.data.loading.view_selection import (
    draws,
    evaluation_views,
    evaluation_views_within,
    nearby_views,
    training_views,
)


def test_training_views_are_distinct_frames_of_the_sequence():
    for index in range(50):
        reference, targets = training_views(6, 4, draws(0, 0, index))
        assert len({reference, *targets}) == 5
        assert {reference, *targets} <= set(range(6))


def test_every_frame_becomes_the_reference_and_a_target_of_every_other():
    pairs = set()
    for index in range(300):
        reference, targets = training_views(4, 2, draws(0, 0, index))
        pairs |= {(reference, target) for target in targets}
    assert pairs == {(i, j) for i in range(4) for j in range(4) if i != j}


def test_short_sequences_repeat_targets_but_never_the_reference():
    reference, targets = training_views(3, 5, draws(0, 0, 0))
    assert len(targets) == 5
    assert set(targets) == {0, 1, 2} - {reference}


def test_a_draw_depends_on_seed_epoch_and_index_only():
    def views(*key: int) -> tuple[int, list[int]]:
        return training_views(100, 4, draws(*key))

    assert views(1, 2, 3) == views(1, 2, 3)
    assert len({str(views(*key)) for key in [(1, 2, 3), (3, 2, 1), (1, 3, 2), (0, 2, 3), (1, 2, 4)]}) == 5


def test_evaluation_takes_the_first_frame_and_all_others():
    assert evaluation_views(5, None) == (0, [1, 2, 3, 4])
    assert evaluation_views(5, 9) == (0, [1, 2, 3, 4])


@pytest.mark.parametrize("frames", [24, 101, 202])
@pytest.mark.parametrize("targets", [1, 3, 8, 20])
def test_a_subset_of_targets_is_evenly_spaced(frames, targets):
    reference, chosen = evaluation_views(frames, targets)
    assert reference == 0
    assert len(set(chosen)) == targets
    assert 0 not in chosen
    steps = np.diff([chosen[-1] - frames, *chosen])
    assert steps.max() - steps.min() <= 2


@pytest.mark.parametrize(("frames", "min_gap", "max_gap"), [(40, 1, 5), (40, 3, 10), (6, 5, 9), (12, 8, 9), (40, 4, 4)])
def test_nearby_views_keep_both_gaps_and_reach_everything_that_does(frames, min_gap, max_gap):
    pairs = set()
    for index in range(3000):
        reference, targets = nearby_views(frames, 3, min_gap, max_gap, draws(0, 0, index))
        assert len(targets) == 3
        pairs |= {(reference, target) for target in targets}
    expected = {(i, j) for i in range(frames) for j in range(frames) if min_gap <= abs(i - j) <= max_gap}
    assert pairs <= expected
    assert {i for i, _ in pairs} == {i for i, _ in expected}
    assert len(pairs) > 0.95 * len(expected)


def test_nearby_targets_are_distinct_where_there_are_enough():
    for index in range(100):
        reference, targets = nearby_views(30, 5, 1, 5, draws(0, 0, index))
        assert len({reference, *targets}) == 6


def test_a_sequence_too_short_for_the_gap_goes_from_end_to_end():
    assert {str(nearby_views(4, 2, 9, 20, draws(0, 0, i))) for i in range(50)} == {"(0, [3, 3])", "(3, [0, 0])"}


@pytest.mark.parametrize(("frames", "targets", "gap"), [(100, 3, 30), (20, 3, 30), (31, 30, 30), (300, 7, 150)])
def test_evaluation_targets_are_spread_over_the_frames_that_follow(frames, targets, gap):
    reference, chosen = evaluation_views_within(frames, targets, gap)
    following = min(gap, frames - 1)
    assert reference == 0
    assert len(set(chosen)) == targets
    assert 1 <= chosen[0] < chosen[-1] <= following
    # As many frames before the first as after the last, up to rounding, and equal steps.
    assert abs((chosen[0] - 1) - (following - chosen[-1])) <= 1
    assert np.ptp(np.diff(chosen)) <= 1


def test_evaluation_targets_repeat_in_short_sequences():
    assert evaluation_views_within(3, 4, 30) == (0, [1, 1, 2, 2])
    assert evaluation_views_within(2, 3, 30) == (0, [1, 1, 1])
