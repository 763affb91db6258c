"""Coverage, distance, sharpness and calibration on constructed truths, whose scores are known in closed form."""

import pytest
import torch

from completesplat.metrics.mode_coverage import (
    EDGES,
    REJECTED,
    bin_sums,
    classify,
    curve,
    draw_modes,
    mean_of,
    mean_scores,
    scores,
    spread_and_error,
)

MODES = torch.rand(4, 50, 3, generator=torch.Generator().manual_seed(0))
EVEN = torch.full((4,), 0.25)
UNEVEN = torch.tensor([0.5, 0.25, 0.25, 0.0])


def plain(*values: float) -> torch.Tensor:
    """Pictures of one value each."""
    return torch.tensor(values).reshape(-1, 1, 1).expand(-1, 5, 3)


def test_a_sampler_of_every_mode_in_proportion_is_perfect():
    found = scores(MODES.repeat(8, 1, 1), MODES, EVEN)
    assert (found.coverage, found.total_variation, found.sharpness, found.rejected) == (1, 0, 0, 0)
    uneven = scores(MODES[[0, 0, 1, 2]], MODES, UNEVEN)
    assert (uneven.coverage, uneven.total_variation) == (1, 0)


@pytest.mark.parametrize("probabilities", [EVEN, UNEVEN])
def test_the_mean_of_the_modes_is_rejected_always(probabilities):
    found = scores(mean_of(MODES, probabilities).expand(5, -1, -1), MODES, probabilities)
    assert (found.coverage, found.total_variation, found.rejected) == (0, 1, 1)
    assert found.sharpness == pytest.approx(1)
    modes, third = plain(0.0, 0.49, 1.0), torch.full((3,), 1 / 3)  # it lies beside a mode
    assert classify(mean_of(modes, third)[None], modes, third).tolist() == [REJECTED]
    assert classify(modes, modes, third).tolist() == [0, 1, 2]


def test_a_sampler_of_one_mode_covers_one_of_k():
    for count in (2, 4):
        modes = MODES[:count]
        found = scores(modes[1:2].expand(6, -1, -1), modes, torch.full((count,), 1 / count))
        assert (found.coverage, found.total_variation) == pytest.approx((1 / count, 1 - 1 / count))
        assert (found.sharpness, found.rejected) == (0, 0)


def test_a_mixture_belongs_to_a_mode_only_on_its_side_of_the_middle_and_near_it():
    shares = torch.tensor([0.0, 0.2, 0.45, 0.5, 0.55, 1.0])[:, None, None]
    mixtures = (1 - shares) * MODES[0] + shares * MODES[1]
    # At 0.45 it is nearer to the mean of these two modes than to either.
    classes = [0, 0, REJECTED, REJECTED, REJECTED, 1]
    assert classify(mixtures, MODES[:2], torch.full((2,), 0.5)).tolist() == classes
    # Beyond half the smallest distance nothing is accepted.
    found = classify(plain(-0.4, -0.6, 5.4, 5.6), plain(0.0, 1.0, 5.0), torch.full((3,), 1 / 3))
    assert found.tolist() == [0, REJECTED, 2, REJECTED]


def test_draws_follow_the_probabilities():
    drawn = classify(draw_modes(MODES, UNEVEN, 4000, seed=1), MODES, UNEVEN)
    shares = torch.bincount(drawn, minlength=4) / 4000
    assert torch.allclose(shares, UNEVEN, atol=4 * 0.5 / 4000**0.5)
    assert shares[3] == 0


def test_rejected_samples_count_as_mass_on_no_mode_and_scenes_the_same():
    samples = torch.cat([MODES[:2], MODES[:2].mean(0, keepdim=True).expand(2, -1, -1)])
    found = scores(samples, MODES, EVEN)
    assert (found.rejected, found.coverage) == (0.5, 0.5)
    assert found.total_variation == pytest.approx(0.5)  # half of 0 + 0 + 1/4 + 1/4 + 1/2
    perfect, blurred = scores(MODES, MODES, EVEN), scores(mean_of(MODES, EVEN)[None], MODES, EVEN)
    mean = mean_scores([perfect, blurred, blurred, perfect])
    assert (mean.coverage, mean.total_variation, mean.rejected) == (0.5, 0.5, 0.5)


SAMPLES = 16
EVERYWHERE = torch.ones(200, 200, dtype=torch.bool)


def drawn(deviation: torch.Tensor, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples and a truth, all of one normal distribution around 0.5."""
    values = torch.randn(SAMPLES + 1, 3, 200, 200, generator=torch.Generator().manual_seed(seed))
    pictures = 0.5 + deviation * values
    return pictures[:-1], pictures[-1]


@pytest.mark.parametrize("deviation", [0.002, 0.3])
def test_a_truth_of_the_same_distribution_lies_on_the_line(deviation):
    variance, error = spread_and_error(*drawn(torch.tensor(deviation), seed=0))
    found = curve(bin_sums(variance, error, EVERYWHERE))
    assert found["variance"] == pytest.approx(deviation**2, rel=0.02)
    assert found["squared_error"] == pytest.approx((1 + 1 / SAMPLES) * found["variance"], rel=0.03)


def test_every_bin_lies_on_the_line_where_the_spread_differs_from_pixel_to_pixel():
    deviation = torch.logspace(-4, 0, 200).expand(200, 200)
    found = curve(bin_sums(*spread_and_error(*drawn(deviation, seed=1)), EVERYWHERE))
    assert len(found["bins"]) == len(EDGES) + 1
    for row in found["bins"]:
        assert row["squared_error"] == pytest.approx((1 + 1 / SAMPLES) * row["variance"], rel=0.15)


def test_equal_samples_fall_into_the_lowest_bin_with_all_their_error():
    truth = torch.rand(3, 8, 8)
    variance, error = spread_and_error(truth.add(0.1).expand(5, 3, 8, 8), truth)
    (row,) = curve(bin_sums(variance, error, torch.ones(8, 8, dtype=torch.bool)))["bins"]
    assert (row["pixels"], row["variance"]) == (64, pytest.approx(0, abs=1e-12))
    assert row["squared_error"] == pytest.approx(0.01, rel=1e-4)


def test_bins_hold_the_variances_between_their_edges_and_sums_add_up():
    samples = torch.rand(4, 2, 3, 9, 9) ** 4
    variance, error = spread_and_error(samples, torch.rand(2, 3, 9, 9))
    region = torch.rand(2, 9, 9) < 0.5
    inside, outside = bin_sums(variance, error, region), bin_sums(variance, error, ~region)
    both = inside + outside
    assert torch.allclose(both, bin_sums(variance, error, torch.ones_like(region)))
    assert curve(both)["squared_error"] == pytest.approx(error.mean().item(), rel=1e-5)
    assert int(both[:, 0].sum()) == region.numel()
    means = both[:, 1] / both[:, 0]
    for lower, mean, upper in zip([0, *EDGES], means, [*EDGES, 1], strict=True):
        assert mean.isnan() or lower <= mean < upper


def test_a_region_without_pixels_has_no_figures():
    nothing = torch.zeros(4, 4)
    found = curve(bin_sums(nothing, nothing, torch.zeros(4, 4, dtype=torch.bool)))
    assert found == {"pixels": 0, "variance": None, "squared_error": None, "bins": []}


def test_modes_that_cannot_be_told_apart_and_a_sample_without_spread_are_refused():
    for modes in (MODES[:1], MODES[[0, 0]], MODES[:, :0]):
        with pytest.raises(ValueError, match="mode"):
            scores(modes, modes, torch.full((len(modes),), 1 / len(modes)))
    with pytest.raises(ValueError, match="two samples"):
        spread_and_error(torch.rand(1, 3, 4, 4), torch.rand(3, 4, 4))
