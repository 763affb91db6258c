import math

import pytest
import torch

from completesplat.training.schedules import constant, cosine, exponential


def factors(schedule, steps: int, **settings) -> list[float]:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    scheduler = schedule(optimizer, **settings)
    values = []
    for _ in range(steps):
        values.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return values


def test_exponential_is_a_straight_line_in_the_logarithm_after_the_warm_up():
    values = factors(exponential, 1201, total_steps=1100, warmup_steps=100, final_ratio=0.01)
    assert values[:100] == pytest.approx([(i + 1) / 100 for i in range(100)])
    assert values[600] == pytest.approx(0.1)
    assert values[350] == pytest.approx(math.exp(math.log(0.01) / 4))
    assert values[1100] == values[1200] == pytest.approx(0.01)


def test_cosine_ends_at_the_final_ratio():
    values = factors(cosine, 301, total_steps=200, warmup_steps=0, final_ratio=0.1)
    assert (values[0], values[100], values[200], values[300]) == pytest.approx((1.0, 0.55, 0.1, 0.1))


def test_constant():
    assert set(factors(constant, 5)) == {1.0}
