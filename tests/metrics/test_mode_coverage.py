"""Coverage, distance and distance to modes on constructed truths, whose scores are known in closed form."""

import pytest
import torch

from completesplat.metrics.mode_coverage import REJECTED, classify, draw_modes, mean_of, scores

MODES = torch.rand(4, 50, 3, generator=torch.Generator().manual_seed(0))
EVEN = torch.full((4,), 0.25)
UNEVEN = torch.tensor([0.5, 0.25, 0.25, 0.0])


def plain(*values: float) -> torch.Tensor:
    """Images of one value each."""
    return torch.tensor(values).reshape(-1, 1, 1).expand(-1, 5, 3)


def test_a_sampler_of_every_mode_in_proportion_is_perfect():
    result = scores(MODES.repeat(8, 1, 1), MODES, EVEN)
    assert (result["coverage"], result["total_variation"], result["mode_distance"], result["rejected"]) == (1, 0, 0, 0)
    uneven = scores(MODES[[0, 0, 1, 2]], MODES, UNEVEN)
    assert (uneven["coverage"], uneven["total_variation"]) == (1, 0)


@pytest.mark.parametrize("probabilities", [EVEN, UNEVEN])
def test_the_mean_of_the_modes_is_rejected_always(probabilities):
    result = scores(mean_of(MODES, probabilities).expand(5, -1, -1), MODES, probabilities)
    assert (result["coverage"], result["total_variation"], result["rejected"]) == (0, 1, 1)
    assert result["mode_distance"] == pytest.approx(1)
    modes, third = plain(0.0, 0.49, 1.0), torch.full((3,), 1 / 3)  # it lies beside a mode
    assert classify(mean_of(modes, third)[None], modes, third).tolist() == [REJECTED]
    assert classify(modes, modes, third).tolist() == [0, 1, 2]


def test_a_mixture_belongs_to_a_mode_only_on_its_side_of_the_middle_and_near_it():
    shares = torch.tensor([0.0, 0.2, 0.45, 0.5, 0.55, 1.0])[:, None, None]
    mixtures = (1 - shares) * MODES[0] + shares * MODES[1]
    # At 0.45 it is nearer to the mean of these two modes than to either.
    classes = [0, 0, REJECTED, REJECTED, REJECTED, 1]
    assert classify(mixtures, MODES[:2], torch.full((2,), 0.5)).tolist() == classes
    # Beyond half the smallest distance nothing is accepted.
    result = classify(plain(-0.4, -0.6, 5.4, 5.6), plain(0.0, 1.0, 5.0), torch.full((3,), 1 / 3))
    assert result.tolist() == [0, REJECTED, 2, REJECTED]


def test_draws_follow_the_probabilities():
    drawn = classify(draw_modes(MODES, UNEVEN, 4000, seed=1), MODES, UNEVEN)
    shares = torch.bincount(drawn, minlength=4) / 4000
    assert torch.allclose(shares, UNEVEN, atol=4 * 0.5 / 4000**0.5)
    assert shares[3] == 0


def test_rejected_samples_count_as_mass_on_no_mode():
    samples = torch.cat([MODES[:2], MODES[:2].mean(0, keepdim=True).expand(2, -1, -1)])
    result = scores(samples, MODES, EVEN)
    assert (result["rejected"], result["coverage"]) == (0.5, 0.5)
    assert result["total_variation"] == pytest.approx(0.5)  # half of 0 + 0 + 1/4 + 1/4 + 1/2
