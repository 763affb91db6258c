"""Which frames are drawn, and that a draw depends on nothing but seed, epoch and index."""

import numpy as np
import pytest

from completesplat.data.view_selection import draws, evaluation_views, training_views


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
