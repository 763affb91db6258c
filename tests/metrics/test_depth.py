"""Depth errors in closed form."""

import math

import pytest
import torch

from completesplat.metrics.scoring import depth_errors


def images(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows)[:, None, None]


def test_errors_are_those_of_a_worked_example():
    true, predicted = images([1.0, 2.0, 4.0, 5.0]), images([1.5, 2.0, 3.0, 6.0])
    (errors,) = depth_errors(predicted, true, torch.ones(1, 1, 1, 4, dtype=torch.bool))
    assert errors["abs_rel"] == pytest.approx((0.5 + 0 + 0.25 + 0.2) / 4)
    assert errors["rmse"] == pytest.approx(math.sqrt((0.25 + 0 + 1 + 1) / 4))
    # Ratios 1.5, 1, 1.33 and 1.2.
    assert errors["delta1"] == 0.5


def test_a_common_scale_is_an_error_of_that_scale():
    true = 1 + torch.rand(2, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    everywhere = torch.ones_like(true, dtype=torch.bool)
    for scale, within in ((1.2, 1.0), (1 / 1.2, 1.0), (1.44, 0.0), (1 / 1.44, 0.0)):
        for errors, depth in zip(depth_errors(scale * true, true, everywhere), true, strict=True):
            assert errors["abs_rel"] == pytest.approx(abs(scale - 1), rel=1e-5)
            assert errors["rmse"] == pytest.approx(abs(scale - 1) * depth.square().mean().sqrt().item(), rel=1e-5)
            assert errors["delta1"] == within


def test_pixels_that_do_not_count_may_hold_anything():
    nan, inf = math.nan, math.inf
    true = images([1.0, 2.0, nan, 0.0, inf, 3.0])
    predicted = images([2.0, 2.0, 1.0, 1.0, 1.0, nan])
    valid = torch.tensor([True, True, True, True, True, False])[None, None, None]
    assert depth_errors(predicted, true, valid) == depth_errors(
        predicted[..., :2], true[..., :2], torch.ones(1, 1, 1, 2, dtype=torch.bool)
    )


def test_an_image_without_valid_pixels_has_no_errors():
    depth = torch.ones(3, 1, 2, 2)
    valid = torch.zeros(3, 1, 2, 2, dtype=torch.bool)
    valid[1] = True
    assert depth_errors(depth, depth, valid) == [None, {"abs_rel": 0, "rmse": 0, "delta1": 1}, None]


def test_a_pixel_without_prediction_is_wrong():
    for nothing in (0.0, -1.0):
        (errors,) = depth_errors(images([nothing]), images([1.0]), torch.ones(1, 1, 1, 1, dtype=torch.bool))
        assert errors == {"abs_rel": 1 - nothing, "rmse": 1 - nothing, "delta1": 0}
