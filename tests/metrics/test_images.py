import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from completesplat.evaluation.protocol import PACKAGE_METRICS
from completesplat.evaluation.regions import object_only
from completesplat.evaluation.tables import SSIM_NOTE
from completesplat.metrics.images import PSNR_LIMIT, psnr, sharpness, ssim


@pytest.fixture(scope="module")
def pair():
    generator = torch.Generator().manual_seed(0)
    true = torch.nn.functional.interpolate(torch.rand(3, 3, 8, 8, generator=generator), size=(40, 36), mode="bicubic")
    noise = 0.1 * torch.randn(3, 3, 40, 36, generator=generator)
    return (true + noise).clamp(0, 1), true.clamp(0, 1)


def test_psnr_agrees_with_skimage(pair):
    expected = [peak_signal_noise_ratio(t.numpy(), p.numpy(), data_range=1) for p, t in zip(*pair, strict=True)]
    np.testing.assert_allclose(psnr(*pair).numpy(), expected, rtol=1e-5)
    assert (psnr(pair[0], pair[0]) == PSNR_LIMIT).all()


def similarity_map(first, second, border):
    """SSIM of every pixel and channel (Wang et al. 2004), blurred by scipy with this treatment of the border."""
    x, y = first.double().numpy(), second.double().numpy()

    def blurred(image):
        return gaussian_filter(image, sigma=1.5, truncate=3.5, mode=border, axes=(1, 2))

    mean_x, mean_y = blurred(x), blurred(y)
    variances = blurred(x * x) - mean_x**2 + blurred(y * y) - mean_y**2
    covariance = blurred(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    return luminance * (2 * covariance + 0.03**2) / (variances + 0.03**2)


def test_ssim_mirrors_images_at_the_border_and_counts_all_pixels(pair):
    settings = {"channel_axis": 0, "data_range": 1, "gaussian_weights": True, "sigma": 1.5}
    for p, t, ours in zip(*pair, ssim(*pair), strict=True):
        similarity = similarity_map(p, t, "mirror")
        assert ours.item() == pytest.approx(similarity.mean(), abs=1e-5)
        theirs = structural_similarity(t.double().numpy(), p.double().numpy(), use_sample_covariance=False, **settings)
        assert similarity[:, 5:-5, 5:-5].mean() == pytest.approx(theirs, abs=1e-9)
    assert PACKAGE_METRICS["completesplat.metrics.images.ssim"]["border"] == "mirrored, counted"
    assert "mean over all pixels, images mirrored at their border" in SSIM_NOTE
    assert "skimage leaves 5 pixels out on every side" in SSIM_NOTE


def test_object_only_is_black_outside_the_binarised_mask():
    image, mask = torch.full((1, 3, 2, 2), 0.8), torch.tensor([[[[0.0, 0.4], [0.6, 1.0]]]])
    assert object_only(image, mask)[0, 0].tolist() == [[0, 0], [pytest.approx(0.8), pytest.approx(0.8)]]


def everywhere(images):
    return torch.ones_like(images[:, :1], dtype=torch.bool)


def test_the_truth_has_sharpness_one_half_the_contrast_a_quarter_and_a_blur_less(pair):
    _, true = pair
    mean = true.mean((2, 3), keepdim=True)
    assert sharpness(true, true, everywhere(true)) == 1
    assert sharpness(true.flip(-1), true, everywhere(true)) == pytest.approx(1, rel=1e-5)
    assert sharpness(mean + (true - mean) / 2, true, everywhere(true)) == pytest.approx(1 / 4, rel=1e-5)
    once, twice = (torch.from_numpy(gaussian_filter(true.numpy(), sigma, axes=(2, 3))) for sigma in (1, 2))
    values = [sharpness(images, true, everywhere(true)) for images in (mean.expand_as(true), twice, once)]
    assert values == sorted(values)
    assert values[0] == pytest.approx(0, abs=1e-6)
    assert values[2] < 1
    assert sharpness(pair[0], true, everywhere(true)) > 1  # noise has gradients, too


def test_sharpness_is_a_ratio_of_sums_over_images_between_pairs_of_counted_pixels(pair):
    predicted, true = pair
    counted = torch.rand(3, 1, 40, 36, generator=torch.Generator().manual_seed(1)) > 0.3

    def energy(images):
        total = 0.0
        for image, mask in zip(images.double().numpy(), counted[:, 0].numpy(), strict=True):
            for row, column in np.argwhere(mask):
                for other in ((row + 1, column), (row, column + 1)):
                    if other[0] < 40 and other[1] < 36 and mask[other]:
                        total += ((image[:, row, column] - image[(slice(None), *other)]) ** 2).sum()
        return total

    assert sharpness(predicted, true, counted) == pytest.approx(energy(predicted) / energy(true), rel=1e-5)


def test_a_truth_without_gradients_has_no_sharpness(pair):
    predicted, true = pair
    flat = torch.full_like(true, 0.5)
    assert sharpness(predicted, flat, everywhere(true)) is None
    assert sharpness(predicted, flat + 1e-7 * true, everywhere(true)) is None  # rounding errors of resized images
    assert sharpness(predicted, true, torch.zeros_like(everywhere(true))) is None
