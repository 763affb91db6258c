"""Errors of depth maps: worked examples."""

import math

import pytest
import torch

from completesplat.metrics.images import depth_errors


def images(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows)[:, None, None]


def everywhere(depth: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(depth, dtype=torch.bool)


def test_errors_are_those_of_a_worked_example_and_a_pixel_without_prediction_is_wrong():
    true, predicted = images([1.0, 2.0, 4.0, 5.0]), images([1.5, 2.0, 3.0, 6.0])
    (errors,) = depth_errors(predicted, true, everywhere(true))
    assert errors["abs_rel"] == pytest.approx((0.5 + 0 + 0.25 + 0.2) / 4)
    assert errors["rmse"] == pytest.approx(math.sqrt((0.25 + 0 + 1 + 1) / 4))
    assert errors["delta1"] == 0.5  # ratios 1.5, 1, 1.33 and 1.2
    for nothing in (0.0, -1.0):
        (errors,) = depth_errors(images([nothing]), images([1.0]), everywhere(images([1.0])))
        assert errors == {"abs_rel": 1 - nothing, "rmse": 1 - nothing, "delta1": 0}


def test_pixels_that_do_not_count_may_hold_anything():
    nan, inf = math.nan, math.inf
    true = images([1.0, 2.0, nan, 0.0, inf, 3.0])
    predicted = images([2.0, 2.0, 1.0, 1.0, 1.0, nan])
    valid = torch.tensor([True, True, True, True, True, False])[None, None, None]
    counted = true[..., :2]
    assert depth_errors(predicted, true, valid) == depth_errors(predicted[..., :2], counted, everywhere(counted))
    depth = torch.ones(2, 1, 2, 2)
    valid = torch.stack([torch.zeros(1, 2, 2), torch.ones(1, 2, 2)]).bool()
    assert depth_errors(depth, depth, valid) == [None, {"abs_rel": 0, "rmse": 0, "delta1": 1}]
