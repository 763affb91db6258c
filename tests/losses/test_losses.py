import pytest
import torch
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from support import some_gaussians
from torchmetrics.functional.image import structural_similarity_index_measure

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.geometry.cameras import Cameras
from completesplat.losses import Prediction, WeightedSum
from completesplat.losses.kl import KullbackLeibler
from completesplat.losses.mse import MeanSquaredError
from completesplat.losses.ssim import StructuralDissimilarity
from completesplat.scene import Views

SHAPE = (2, 3, 3, 24, 24)


def views(images: torch.Tensor) -> Views:
    cameras = Cameras(torch.eye(4).expand(2, 3, 4, 4), torch.eye(3).expand(2, 3, 3, 3), (24, 24))
    return Views(images, cameras, torch.ones(2, 3, 1, 24, 24))


def prediction(images: torch.Tensor, with_posterior: bool = True) -> Prediction:
    posterior = Posterior(torch.ones(2, 4, 1, 1), torch.zeros(2, 4, 1, 1)) if with_posterior else None
    return Prediction(images, some_gaussians(len(images)), posterior)


@pytest.fixture(scope="module")
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(SHAPE, generator=generator), torch.rand(SHAPE, generator=generator)


def test_ssim_of_equal_images_costs_nothing(pair):
    assert StructuralDissimilarity()(prediction(pair[0]), views(pair[0])).item() == pytest.approx(0, abs=1e-5)


def test_ssim_is_one_minus_torchmetrics_value(pair):
    """The two libraries differ at the border only: compare smooth images, on which the border has its mean value."""
    smooth = [torch.nn.functional.avg_pool2d(x.flatten(0, 1), 5, 1, 2, count_include_pad=False) for x in pair]
    ours = StructuralDissimilarity()(prediction(smooth[0].view(SHAPE)), views(smooth[1].view(SHAPE)))
    theirs = structural_similarity_index_measure(smooth[0], smooth[1], data_range=1.0)
    assert ours.item() == pytest.approx(1 - theirs.item(), abs=0.05)


def test_kl_is_summed_over_the_latent_and_divided_by_the_values_of_a_picture(pair):
    # N(1, 1) against N(0, 1) is 1/2 per element, of which there are four; a picture has 3 * 24 * 24 values.
    value = KullbackLeibler()(prediction(pair[0]), views(pair[1])).item()
    assert value == pytest.approx(2.0 / (3 * 24 * 24))
    assert KullbackLeibler()(prediction(pair[0], with_posterior=False), views(pair[1])).item() == 0


@pytest.mark.parametrize("size", [16, 64])
def test_kl_weighs_as_in_stable_diffusion_at_every_image_size(size):
    """There, sum of errors + 1e-6 * KL; divided by the 3 * H * W values of a picture, mean error + our term."""
    shape = (1, 2, 3, size, size)
    first, second = torch.rand(shape), torch.rand(shape)
    mean, log_variance = torch.randn(1, 4, size // 8, size // 8), torch.randn(1, 4, size // 8, size // 8)
    cameras = Cameras(torch.eye(4).expand(1, 2, 4, 4), torch.eye(3).expand(1, 2, 3, 3), (size, size))
    truth = Views(second, cameras, torch.ones(1, 2, 1, size, size))
    terms = {
        "mse": {"weight": 1.0, "term": MeanSquaredError()},
        "ssim": None,  # as good as not there
        "kl": {"weight": 1e-6, "term": KullbackLeibler()},
    }
    total, values = WeightedSum(terms)(Prediction(first, some_gaussians(1), Posterior(mean, log_variance)), truth)
    theirs = DiagonalGaussianDistribution(torch.cat([mean, log_variance], dim=1)).kl().sum()
    assert set(values) == {"mse", "kl"}
    errors = (first - second).square().sum() / 2  # of one picture
    assert total.item() == pytest.approx(((errors + 1e-6 * theirs) / (3 * size * size)).item(), rel=1e-5)
