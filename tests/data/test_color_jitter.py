"""Colour jitter: one change of colours for all views, within stated bounds."""

import numpy as np
import pytest
import torch
from torch import Tensor

from completesplat.data.loading.augmentation import ColorJitter
from completesplat.errors import CompleteSplatError

STRONG = ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.5)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("seed", range(8))
def test_one_color_becomes_one_color_in_all_views(seed: int) -> None:
    """Also where the rest of the views is bright in one and dark in the other."""
    images = torch.cat([pictures(1, 3, 8, 8) * 0.3, 0.7 + pictures(1, 3, 8, 8) * 0.3])
    images[:, :, 2, 3] = torch.tensor([0.2, 0.5, 0.6])
    jittered = STRONG(images, rng(seed))
    assert not torch.allclose(jittered[0, :, 2, 3], images[0, :, 2, 3], atol=1e-3)
    torch.testing.assert_close(jittered[0, :, 2, 3], jittered[1, :, 2, 3])


def test_identical_pictures_stay_identical_and_all_stay_within_bounds() -> None:
    images = pictures(1, 3, 6, 5).repeat(4, 1, 1, 1)
    for seed in range(30):
        jittered = STRONG(images, rng(seed))
        assert jittered.shape == images.shape
        assert torch.equal(jittered, jittered[:1].expand_as(jittered))
        assert jittered.min() >= 0
        assert jittered.max() <= 1


def test_views_and_pixels_keep_their_places() -> None:
    images = torch.full((3, 3, 4, 5), 0.1)
    images[1, 0, 2, 3] = 0.9
    jittered = ColorJitter(0.2, 0.2, 0.2, 0)(images, rng(3))
    others = torch.ones(3, 4, 5, dtype=torch.bool)
    others[1, 2, 3] = False
    rest = jittered.movedim(1, -1)[others]
    torch.testing.assert_close(rest, rest[:1].expand_as(rest))
    assert jittered[1, 0, 2, 3] > jittered[0, 0, 2, 3] + 0.1


def test_strengths_of_zero_change_nothing() -> None:
    images = pictures(2, 3, 7, 7)
    assert torch.equal(ColorJitter(0, 0, 0, 0)(images, rng()), images)


def test_brightness_alone_multiplies_by_a_factor_within_its_range() -> None:
    images = 0.1 + 0.4 * pictures(2, 3, 5, 5)
    factors = []
    for seed in range(200):
        ratio = ColorJitter(0.5, 0, 0, 0)(images, rng(seed)) / images
        torch.testing.assert_close(ratio, ratio[:1, :1, :1, :1].expand_as(ratio))
        factors.append(ratio[0, 0, 0, 0].item())
    assert min(factors) >= 0.5
    assert max(factors) <= 1.5
    assert min(factors) < 0.55
    assert max(factors) > 1.45


def test_hue_rotates_colors_and_keeps_grey_grey() -> None:
    images = pictures(2, 1, 5, 5).repeat(1, 3, 1, 1)
    images[:, :, 0, 0] = torch.tensor([1.0, 0, 0])
    jittered = ColorJitter(0, 0, 0, 0.5)(images, rng(1))
    torch.testing.assert_close(jittered[:, :, 1:], images[:, :, 1:])
    # A pure colour of whichever hue has one channel at 1 and one at 0.
    color = jittered[0, :, 0, 0]
    torch.testing.assert_close(torch.stack([color.min(), color.max()]), torch.tensor([0.0, 1.0]))
    assert not torch.allclose(color, torch.tensor([1.0, 0, 0]), atol=1e-2)


def test_half_a_turn_of_hue_is_the_complement() -> None:
    """Of all angles within half a turn, the farthest from red is cyan; some draw comes near it, none beyond."""
    red = torch.zeros(1, 3, 1, 1)
    red[:, 0] = 1
    reds = [ColorJitter(0, 0, 0, 0.5)(red, rng(seed))[0, :, 0, 0] for seed in range(300)]
    assert min((color - torch.tensor([0.0, 1, 1])).abs().max() for color in reds) < 0.1
    quarter = [ColorJitter(0, 0, 0, 0.25)(red, rng(seed))[0, :, 0, 0] for seed in range(300)]
    # A quarter turn either way ends half-way between yellow and green, or between magenta and blue.
    assert all(color[0] >= 0.5 - 1e-5 for color in quarter)
    assert min(color[0] for color in quarter) < 0.55


def test_contrast_moves_colors_about_the_mean_grey_of_the_scene() -> None:
    images = 0.3 + 0.4 * pictures(3, 3, 8, 8)
    grey = torch.tensor([0.299, 0.587, 0.114])  # Rec. 601
    mean = torch.einsum("vchw,c->", images, grey) / (3 * 64)
    ratio = (ColorJitter(0, 0.3, 0, 0)(images, rng(2)) - mean) / (images - mean)
    usable = (images - mean).abs() > 0.05
    torch.testing.assert_close(ratio[usable], ratio[usable][:1].expand(int(usable.sum())), atol=1e-4, rtol=0)
    assert abs(ratio[usable][0] - 1) > 0.01


def test_saturation_scales_the_distance_from_the_grey_of_each_pixel() -> None:
    images = 0.3 + 0.4 * pictures(3, 3, 8, 8)
    grey = torch.einsum("vchw,c->vhw", images, torch.tensor([0.299, 0.587, 0.114]))[:, None]  # Rec. 601
    ratio = (ColorJitter(0, 0, 0.3, 0)(images, rng(2)) - grey) / (images - grey)
    usable = (images - grey).abs() > 0.05
    torch.testing.assert_close(ratio[usable], ratio[usable][:1].expand(int(usable.sum())), atol=1e-4, rtol=0)
    assert abs(ratio[usable][0] - 1) > 0.01


@pytest.mark.parametrize(
    "strengths", [{"brightness": -0.1}, {"contrast": float("nan")}, {"saturation": float("inf")}, {"hue": 0.6}]
)
def test_strengths_without_meaning_are_refused_by_name(strengths: dict[str, float]) -> None:
    with pytest.raises(CompleteSplatError, match=next(iter(strengths))):
        ColorJitter(**{"brightness": 0, "contrast": 0, "saturation": 0, "hue": 0, **strengths})
