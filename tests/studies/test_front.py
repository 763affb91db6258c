"""Differences of samples in the reference view, in closed form."""

from dataclasses import replace

import pytest
import torch

from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.scene import SceneBatch, Views
from completesplat.studies.front import difference, figures
from completesplat.tensors import stack

SIZE = 16


def scene() -> SceneBatch:
    """A reference view from the front and targets from the left and from behind; the object is the middle column."""
    eyes, center = torch.tensor([[0.0, 0, 0], [-3, 0, 3], [0, 0, 6]]), torch.tensor([0.0, 0, 3])
    poses, masks = look_at(eyes, center, torch.tensor([0.0, -1, 0])), torch.zeros(3, 1, SIZE, SIZE)
    masks[..., SIZE // 2] = 1
    views = Views(torch.rand(3, 3, SIZE, SIZE), Cameras(poses, pinhole(40, SIZE).expand(3, 3, 3), (SIZE, SIZE)), masks)
    return stack(
        [SceneBatch(views[0], views[1:], torch.tensor([1.0, 5]), torch.ones(1, SIZE, SIZE), torch.tensor(0), "a")]
    )


def test_difference_is_the_mean_over_pairs_inside_the_mask():
    images = torch.zeros(3, 3, 4, 4)
    images[1, ..., 0], images[2, ..., 0] = 1 / 255, 4 / 255
    mask = torch.zeros(1, 4, 4, dtype=torch.bool)
    assert difference(images, mask) is None
    mask[..., 0] = True
    assert difference(images, mask) == pytest.approx((1 + 4 + 3) / 3)
    assert difference(images, mask | True) == pytest.approx((1 + 4 + 3) / 3 / 4)
    assert difference(images[:1], mask) == 0


def test_figures_of_two_views_for_all_pixels_and_for_the_object():
    batch = scene()
    images = batch.all_views().images.repeat(2, 1, 1, 1, 1)
    images[1, 0, ..., SIZE // 2] += 0.1
    images[1, 2] += 0.5
    result = figures(images, batch)
    assert result["reference_object_psnr"] == pytest.approx(23.01, abs=0.01)  # half of the samples are 0.1 off
    assert result["reference_psnr"] == pytest.approx(23.01 + 12.04, abs=0.01)  # in one column of 16
    assert result["reference_object_difference"] == pytest.approx(25.5, rel=1e-4)
    assert result["reference_difference"] == pytest.approx(25.5 / SIZE, rel=1e-4)
    assert result["far_difference"] == pytest.approx(127.5, rel=1e-4) == result["far_object_difference"]
    nothing = replace(batch.reference, masks=torch.zeros_like(batch.reference.masks))
    result = figures(images, replace(batch, reference=nothing))
    assert (result["reference_object_psnr"], result["reference_object_difference"]) == (None, None)
