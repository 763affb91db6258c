"""The calibration curve of samplers whose distribution is known."""

import pytest
import torch

from completesplat.metrics.mode_coverage import EDGES, bin_sums, curve, spread_and_error

SAMPLES = 16
EVERYWHERE = torch.ones(200, 200, dtype=torch.bool)


def drawn(deviation: torch.Tensor, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples and a truth, all of one normal distribution around 0.5."""
    values = torch.randn(SAMPLES + 1, 3, 200, 200, generator=torch.Generator().manual_seed(seed))
    pictures = 0.5 + deviation * values
    return pictures[:-1], pictures[-1]


@pytest.mark.parametrize("deviation", [0.002, 0.02, 0.3])
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


def test_one_sample_has_no_spread():
    with pytest.raises(ValueError, match="two samples"):
        spread_and_error(torch.rand(1, 3, 4, 4), torch.rand(3, 4, 4))
