"""Diversity in closed form."""

import pytest
import torch

from completesplat.metrics.scoring import diversity


def test_diversity_is_the_mean_difference_of_all_pairs():
    images = torch.tensor([0.1, 0.2, 0.5]).view(3, 1, 1, 1, 1).expand(3, 2, 3, 4, 4)
    assert diversity(images) == pytest.approx((0.1 + 0.4 + 0.3) / 3)
    assert diversity(images[:1].expand(3, 2, 3, 4, 4)) == 0


def test_one_sample_has_no_diversity():
    with pytest.raises(ValueError, match="two samples"):
        diversity(torch.zeros(1, 2, 3, 4, 4))
