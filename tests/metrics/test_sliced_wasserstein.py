"""Sliced Wasserstein distance: identities, closed forms, and scipy's filter and one-dimensional distance."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve
from scipy.stats import wasserstein_distance

from completesplat.metrics.image_sets import (
    descriptors,
    expand,
    laplacian_pyramid,
    projected_distance,
    sliced_wasserstein,
)

SEEDS = list(range(100, 108))


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Squares on smooth grounds."""
    generator = torch.Generator().manual_seed(0)
    made = torch.nn.functional.interpolate(torch.rand(8, 3, 4, 4, generator=generator), size=(64, 64), mode="bilinear")
    for image in made:
        top, left = torch.randint(40, (2,), generator=generator).tolist()
        image[:, top : top + 20, left : left + 20] = torch.rand(3, 1, 1, generator=generator)
    return made


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


@pytest.mark.parametrize(
    ("size", "sizes"),
    [((64, 64), [(64, 64), (32, 32), (16, 16)]), ((33, 70), [(33, 70), (17, 35)]), ((31, 16), [(31, 16)])],
)
def test_the_pyramid_goes_down_to_16_pixels_and_reconstructs_the_image(size, sizes):
    image = torch.rand(2, 3, *size, generator=generator())
    levels = laplacian_pyramid(image)
    assert [tuple(level.shape[-2:]) for level in levels] == sizes
    whole = levels[-1]
    for level in reversed(levels[:-1]):
        whole = level + expand(whole, level.shape[-2:])
    torch.testing.assert_close(whole, image)


def test_the_filter_is_burt_and_adelsons():
    image = torch.rand(1, 3, 32, 33, generator=generator(), dtype=torch.float64)
    kernel = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256
    blurred = np.stack([convolve(channel.numpy(), kernel, mode="mirror") for channel in image[0]])
    np.testing.assert_allclose(laplacian_pyramid(image)[1][0].numpy(), blurred[:, ::2, ::2], atol=1e-12)


def test_descriptors_are_patches_of_the_levels_however_a_set_is_split(images):
    described = descriptors(images[:2], SEEDS[:2], patches=5)
    parts = zip(*(descriptors(images[i : i + 1], SEEDS[i : i + 1], patches=5) for i in range(2)), strict=True)
    for level, patches, pieces in zip(laplacian_pyramid(images[:2]), described, parts, strict=True):
        assert patches.shape == (10, 147)
        for i, patch in enumerate(patches.view(2, 5, 3, 7, 7).flatten(0, 1)):
            windows = level[i // 5].unfold(1, 7, 1).unfold(2, 7, 1).movedim(0, 2)
            assert (windows == patch).all((2, 3, 4)).sum() >= 1
        assert len(patches.unique(dim=0)) == 10
        torch.testing.assert_close(patches, torch.cat(pieces))


def test_patches_lie_anywhere_with_equal_chance():
    ramp = torch.arange(16.0).expand(1, 3, 16, 16) / 16
    for image in (ramp, ramp.mT):
        (patches,) = descriptors(image, [0], patches=4000)
        places = (16 * patches.view(4000, 3, 7, 7)[:, 0, 3, 3]).round().int() - 3
        counts = torch.bincount(places, minlength=10)
        assert len(counts) == 10
        assert (counts - 400).abs().max() < 95  # binomial deviation 19


def test_equal_sets_have_no_distance_in_any_order(images):
    order = torch.randperm(8, generator=generator()).tolist()
    noisy = images + 0.1 * torch.rand(images.shape, generator=generator())
    true, noisy = (descriptors(x, SEEDS, patches=16) for x in (images, noisy))
    shuffled = descriptors(images[order], [SEEDS[i] for i in order], patches=16)
    assert sliced_wasserstein(true, true) == 0
    assert sliced_wasserstein(true, shuffled) == pytest.approx(0, abs=1e-3)
    distance = sliced_wasserstein(true, noisy)
    assert sliced_wasserstein(shuffled, noisy) == pytest.approx(distance, rel=1e-4)
    assert sliced_wasserstein(noisy, true) == pytest.approx(distance, rel=1e-6)


def test_brightness_and_contrast_of_a_whole_sets_channel_do_not_count(images):
    factor, offset = torch.tensor([0.5, 0.9, 0.7]).view(3, 1, 1), torch.tensor([0.2, 0.0, 0.1]).view(3, 1, 1)
    true, changed = (descriptors(x, SEEDS, patches=16) for x in (images, factor * images + offset))
    assert sliced_wasserstein(true, changed) == pytest.approx(0, abs=0.05)
    # Nor is rounding taken for a pattern.
    one, other = (descriptors(torch.full((2, 3, 64, 64), grey), [1, 2], patches=8) for grey in (0.3, 0.7))
    assert 0 <= sliced_wasserstein(one, other) < 10
    assert math.isfinite(sliced_wasserstein(one, descriptors(images[:2], [1, 2], patches=8)))


def test_on_a_line_the_distance_is_scipys():
    first, second = torch.randn(2, 300, 1, generator=generator())
    second = 2 * second + 1
    expected = wasserstein_distance(first[:, 0].numpy(), second[:, 0].numpy())
    assert projected_distance(first, second, 4, generator()).item() == pytest.approx(expected, rel=1e-5)


def test_levels_are_averaged_and_multiplied_by_1000(images):
    first, second = (descriptors(x, SEEDS, patches=16) for x in (images, images.flip(1).square()))
    rng = np.random.default_rng(0)
    levels = []
    for one, other in zip(first, second, strict=True):
        sets = [x.double().numpy().reshape(-1, 3, 49) for x in (one, other)]
        sets = [(x - x.mean((0, 2), keepdims=True)) / x.std((0, 2), keepdims=True) for x in sets]
        lines = rng.standard_normal((400, 147))
        lines /= np.linalg.norm(lines, axis=1, keepdims=True)
        pairs = zip(*(lines @ x.reshape(len(x), 147).T for x in sets), strict=True)
        levels.append(np.mean([wasserstein_distance(*pair) for pair in pairs]))
    assert sliced_wasserstein(first, second) == pytest.approx(1000 * np.mean(levels), rel=0.1)


def test_small_images_are_refused(images):
    with pytest.raises(ValueError, match="at least 16 pixels"):
        descriptors(images[..., :15], SEEDS)
