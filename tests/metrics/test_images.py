import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from completesplat.metrics.images import PSNR_LIMIT, object_only, psnr, ssim


@pytest.fixture(scope="module")
def pair():
    generator = torch.Generator().manual_seed(0)
    true = torch.nn.functional.interpolate(torch.rand(3, 3, 8, 8, generator=generator), size=(40, 36), mode="bicubic")
    noise = 0.1 * torch.randn(3, 3, 40, 36, generator=generator)
    return (true + noise).clamp(0, 1), true.clamp(0, 1)


def test_psnr_agrees_with_skimage(pair):
    expected = [peak_signal_noise_ratio(t.numpy(), p.numpy(), data_range=1) for p, t in zip(*pair, strict=True)]
    np.testing.assert_allclose(psnr(*pair).numpy(), expected, rtol=1e-5)


def test_ssim_agrees_with_skimage(pair):
    """Ours averages over the whole image, skimage over all but a border of 5 pixels: where that is equal, over 1s."""
    framed = [torch.nn.functional.pad(x, (12, 12, 12, 12), value=0.5) for x in pair]
    height, width = framed[0].shape[-2:]
    inner = (height - 10) * (width - 10) / (height * width)
    settings = {"channel_axis": 0, "data_range": 1, "gaussian_weights": True, "sigma": 1.5}
    expected = [
        structural_similarity(t.numpy(), p.numpy(), use_sample_covariance=False, **settings) * inner + 1 - inner
        for p, t in zip(*(x.double() for x in framed), strict=True)
    ]
    np.testing.assert_allclose(ssim(*framed).numpy(), expected, atol=1e-4)


def test_identical_images_have_the_highest_reported_psnr(pair):
    assert (psnr(pair[0], pair[0]) == PSNR_LIMIT).all()


def test_object_only_is_black_outside_the_binarised_mask():
    image, mask = torch.full((1, 3, 2, 2), 0.8), torch.tensor([[[[0.0, 0.4], [0.6, 1.0]]]])
    assert object_only(image, mask)[0, 0].tolist() == [[0, 0], [pytest.approx(0.8), pytest.approx(0.8)]]
