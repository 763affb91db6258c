import math

import pytest
import torch

from completesplat.metrics.proper_scores import crps, energy_score, rank_histogram

K, D = 4, 0.8
# Corners of a regular simplex: K forms at mutual distance D as a root mean square over K values.
FORMS = torch.eye(K, dtype=torch.float64) * D * math.sqrt(K / 2)
DRAWS = 4000


def mean_energy(samples):
    return sum(energy_score(samples, form) for form in FORMS) / K


def test_draws_of_the_truth_have_the_exact_energy_score():
    generator = torch.Generator().manual_seed(0)
    draws = (FORMS[torch.randint(K, (8,), generator=generator)] for _ in range(DRAWS))  # unbiased: also with 8 samples
    result = [energy_score(drawn, FORMS[i % K]) for i, drawn in enumerate(draws)]
    assert sum(result) / DRAWS == pytest.approx(0.375 * D, abs=0.004)


def test_one_form_always_and_their_mean_have_exact_energy_scores_and_noise_around_the_mean_gains_nothing():
    assert mean_energy(FORMS[:1].expand(5, -1)) == pytest.approx(0.75 * D)
    assert mean_energy(FORMS.mean(0).expand(5, -1)) == pytest.approx(math.sqrt(3 / 8) * D)
    noise = 0.1 * torch.randn(200, K, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert mean_energy(FORMS.mean(0) + noise) > 0.375 * D * 1.4


@pytest.mark.slow
def test_scores_are_those_of_an_independent_implementation():
    import scoringrules  # compiles for seconds when it is loaded

    samples = torch.rand(6, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    truth = torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    each = scoringrules.crps_ensemble(truth.numpy(), samples.numpy(), m_axis=0, estimator="fair")
    assert crps(samples, truth) == pytest.approx(each.mean())
    energy = scoringrules.es_ensemble(truth.numpy(), samples.numpy(), estimator="fair")
    assert energy_score(samples, truth) == pytest.approx(float(energy) / math.sqrt(50))


def test_crps_of_equal_samples_is_the_mean_absolute_error():
    truth = torch.rand(9)
    assert crps(torch.zeros(3, 9), truth) == pytest.approx(truth.mean().item())


def test_ranks_are_flat_for_draws_of_one_distribution():
    values = torch.randn(10, 200_000, generator=torch.Generator().manual_seed(0))
    result = rank_histogram(values[1:], values[0])
    assert result.shape == (10,)
    torch.testing.assert_close(result, torch.full((10,), 0.1, dtype=torch.float64), atol=0.004, rtol=0)


def test_equal_values_share_their_ranks():
    result = rank_histogram(torch.tensor([[0.0], [0.5], [0.5]]), torch.tensor([0.5]))
    torch.testing.assert_close(result, torch.tensor([0, 1, 1, 1], dtype=torch.float64) / 3)
