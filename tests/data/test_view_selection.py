import numpy as np
import pytest

from completesplat.data.loading.view_selection import (
    GrowingGap,
    evaluation_views,
    evaluation_views_within,
    item_generator,
    nearby_views,
    training_views,
)
from completesplat.errors import CompleteSplatError


def test_every_frame_becomes_the_reference_and_a_target_of_every_other():
    drawn = [training_views(4, 2, item_generator(0, 0, index)) for index in range(300)]
    pairs = {(reference, target) for reference, targets in drawn for target in targets}
    assert pairs == {(i, j) for i in range(4) for j in range(4) if i != j}
    near = [nearby_views(30, 5, 1, 5, item_generator(0, 0, index)) for index in range(100)]
    for views, count in ((drawn, 3), (near, 6)):
        assert all(len({reference, *targets}) == count for reference, targets in views)
    assert evaluation_views(5, None) == evaluation_views(5, 9) == (0, [1, 2, 3, 4])


def test_short_sequences_repeat_targets_but_never_the_reference():
    reference, targets = training_views(3, 5, item_generator(0, 0, 0))
    assert (len(targets), set(targets)) == (5, {0, 1, 2} - {reference})
    assert {str(nearby_views(4, 2, 9, 20, item_generator(0, 0, i))) for i in range(50)} == {
        "(0, [3, 3])",
        "(3, [0, 0])",
    }
    assert evaluation_views_within(3, 4, 30) == (0, [1, 1, 2, 2])
    assert evaluation_views_within(300, 1, 150) == (0, [150])  # DFM's, `experiment_scripts/re_results.py`
    assert evaluation_views_within(100, 1, 150) == (0, [99])


def test_a_draw_depends_on_seed_epoch_and_index_only():
    keys = [(1, 2, 3), (3, 2, 1), (1, 3, 2), (0, 2, 3), (1, 2, 4)]
    one, other = ([str(training_views(100, 4, item_generator(*key))) for key in keys] for _ in range(2))
    assert one == other
    assert len(set(one)) == 5


@pytest.mark.parametrize("frames", [24, 202])
@pytest.mark.parametrize("targets", [1, 3, 20])
def test_a_subset_of_targets_is_evenly_spaced(frames, targets):
    reference, chosen = evaluation_views(frames, targets)
    assert reference == 0
    assert len({0, *chosen}) == targets + 1
    assert np.ptp(np.diff([chosen[-1] - frames, *chosen])) <= 2


@pytest.mark.parametrize(("frames", "min_gap", "max_gap"), [(40, 3, 10), (12, 8, 9)])
def test_nearby_views_keep_both_gaps_and_reach_everything_that_does(frames, min_gap, max_gap):
    pairs = set()
    for index in range(3000):
        reference, targets = nearby_views(frames, 3, min_gap, max_gap, item_generator(0, 0, index))
        assert len(targets) == 3
        pairs |= {(reference, target) for target in targets}
    expected = {(i, j) for i in range(frames) for j in range(frames) if min_gap <= abs(i - j) <= max_gap}
    assert pairs <= expected
    assert {i for i, _ in pairs} == {i for i, _ in expected}
    assert len(pairs) > 0.95 * len(expected)


@pytest.mark.parametrize(("frames", "targets", "gap"), [(100, 3, 30), (20, 3, 30), (31, 30, 30), (300, 7, 150)])
def test_evaluation_targets_are_spread_over_the_frames_that_follow(frames, targets, gap):
    reference, chosen = evaluation_views_within(frames, targets, gap)
    assert (reference, len(set(chosen))) == (0, targets)
    assert (chosen[0] >= 1, chosen[-1]) == (True, min(gap, frames - 1))
    assert np.ptp(np.diff([reference, *chosen])) <= 1


def test_a_growing_gap_is_linear_in_the_epoch_and_ends_at_its_last() -> None:
    gap = GrowingGap(first=30, last=150, epochs=50)
    assert [gap.at(epoch) for epoch in (0, 25, 50, 90)] == [30, 90, 150, 150]
    assert GrowingGap(7, 7, 0).at(0) == 7
    for first, last, epochs in [(0, 5, 1), (6, 5, 1), (5, 6, -1)]:
        with pytest.raises(CompleteSplatError, match="max_gap"):
            GrowingGap(first, last, epochs)
