"""FID and KID against computations by other means."""

from itertools import combinations, product

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from completesplat.metrics.image_sets import frechet_distance, kernel_distance


@pytest.fixture(scope="module")
def features() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mixing = torch.randn(6, 6, generator=generator)
    return torch.randn(50, 6, generator=generator) @ mixing, 0.3 + torch.randn(40, 6, generator=generator).abs()


def moments(features: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    values = features.double().numpy()
    return values.mean(0), np.cov(values, rowvar=False)


def test_frechet_distance_agrees_with_a_matrix_square_root(features):
    (mean, covariance), (other_mean, other_covariance) = (moments(x) for x in features)
    root = sqrtm(covariance @ other_covariance).real
    expected = ((mean - other_mean) ** 2).sum() + np.trace(covariance + other_covariance - 2 * root)
    assert frechet_distance(*features) == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(*reversed(features)) == pytest.approx(expected, rel=1e-6)
    few = features[0][:4]  # fewer items than features
    assert frechet_distance(few, few.flip(0)) == pytest.approx(0, abs=1e-4)


def test_small_differences_beside_a_large_mean_are_kept(features):
    near = frechet_distance(features[0].double(), features[0].double() * 1.01)
    far = frechet_distance(features[0].double() + 3e4, (features[0].double() * 1.01) + 3e4)
    mean, covariance = moments(features[0])
    assert near == pytest.approx(1e-4 * ((mean**2).sum() + np.trace(covariance)), rel=1e-4)
    assert far == pytest.approx(near, rel=1e-2)


def kernel(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other / len(one) + 1) ** 3


def test_kernel_distance_agrees_with_sums_over_pairs(features):
    first, second = (x[:12].double().numpy() for x in features)
    within = [np.mean([kernel(a, b) for a, b in combinations(values, 2)]) for values in (first, second)]
    expected = sum(within) - 2 * np.mean([kernel(a, b) for a, b in product(first, second)])
    result = kernel_distance(features[0][:12], features[1][:12], subsets=2)
    assert result == pytest.approx(expected, rel=1e-9)


def test_the_seed_alone_decides_the_subsets(features):
    torch.manual_seed(1)
    one = kernel_distance(*features, subset_size=10, subsets=3, seed=5)
    state = torch.get_rng_state()
    assert kernel_distance(*features, subset_size=10, subsets=3, seed=5) == one
    assert kernel_distance(*features, subset_size=10, subsets=3, seed=6) != one
    assert torch.equal(torch.get_rng_state(), state)


def test_sets_are_not_added_up_over_processes(features, monkeypatch):
    expected = frechet_distance(*features)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda *_: 2)
    assert frechet_distance(*features) == expected
