from dataclasses import replace

import pytest
import torch
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from hydra.utils import instantiate
from kornia.metrics import ssim as kornia_ssim
from scenes_for_training import SIZE, prediction, quiet_trainer, scene_batch, views
from support import NETWORKS, compose_config, round_gaussians
from torch import Tensor
from torch.utils.data import DataLoader
from torchmetrics.functional.image import structural_similarity_index_measure

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import pixel_rays
from completesplat.losses import Prediction, WeightedSum
from completesplat.losses.ssim import structural_similarity
from completesplat.losses.terms import KullbackLeibler, MeanSquaredError, Silhouettes, StructuralDissimilarity
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import Views

SHAPE = (2, 3, 3, 24, 24)


@pytest.fixture(scope="module")
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(SHAPE, generator=generator), torch.rand(SHAPE, generator=generator)


def test_ssim_has_the_values_and_gradients_of_other_libraries(pair):
    first, second = (images.flatten(0, 1)[..., :20].double() for images in pair)
    values = structural_similarity(first.requires_grad_(), second)
    assert values.mean().item() == pytest.approx(kornia_ssim(first, second, window_size=11).mean().item(), abs=2e-9)
    theirs = structural_similarity_index_measure(first, second, data_range=1.0, reduction="none")
    torch.testing.assert_close(values.mean((1, 2, 3)), theirs, rtol=0, atol=1e-12)
    (ours,) = torch.autograd.grad(values.mean(), first)
    (expected,) = torch.autograd.grad(theirs.mean(), first)
    torch.testing.assert_close(ours, expected, rtol=0, atol=1e-12)


def test_ssim_is_computed_in_full_precision_and_a_training_may_follow_a_test(pair):
    term = StructuralDissimilarity()
    truth = views(pair[1][..., :23, :23])
    images = pair[0][..., :23, :23].clone()
    with torch.inference_mode():
        full = term(prediction(images), truth)
    with torch.autocast("cpu", torch.bfloat16):
        assert term(prediction(images.requires_grad_()), truth) == full
    term(prediction(images), truth).backward()
    assert term(prediction(truth.images), truth).item() == pytest.approx(0, abs=1e-5)


def wall_of_gaussians(opacity: float) -> Gaussians:
    """Gaussians of an image's pixels, one layer: the left half, at depth 1, hides the right half behind it."""
    camera = scene_batch(1, 1).reference.cameras
    rays = pixel_rays(camera).flatten(1, 2)
    left = torch.arange(SIZE).expand(SIZE, SIZE).flatten() < SIZE // 2
    behind = rays.view(1, SIZE, SIZE, 3).roll(SIZE // 2, dims=2).view(1, -1, 3) * 2
    means = torch.where(left[None, :, None], rays, behind)
    gaussians = round_gaussians(means[0], 0.02, 1.0, 0.5)[None]
    return replace(gaussians, opacities=torch.where(left, opacity, 1.0)[None])


def test_silhouettes_are_what_the_objects_own_gaussians_show():
    scene = scene_batch(1, 2)
    masks = (torch.arange(SIZE) < SIZE // 2).float().expand(1, 3, 1, SIZE, SIZE)
    truth = replace(scene.all_views(), masks=masks)
    term = Silhouettes(ReferenceRasterizer(), views=2)

    def value(gaussians: Gaussians) -> Tensor:
        return term(Prediction(truth.images, gaussians, None), truth)

    solid = wall_of_gaussians(1.0)
    thin = replace(solid, opacities=wall_of_gaussians(0.1).opacities.requires_grad_())
    colors = replace(solid, colors=torch.rand_like(solid.colors))
    assert value(solid) < 0.05
    assert value(thin) > 3 * value(solid)
    assert value(colors) == value(solid)
    value(thin).backward()
    left = masks[0, 0].flatten() > 0
    assert (thin.opacities.grad[0, left] < 0).float().mean() > 0.9
    with pytest.raises(CompleteSplatError, match="for stage 1"):
        value(solid[:, :7])


@pytest.mark.parametrize("size", [16, 64])
def test_kl_weighs_as_in_stable_diffusion_at_every_image_size(size):
    """There, sum of errors + 1e-6 * KL; divided by the 3 * H * W values of an image, mean error + our term."""
    first, second = torch.rand(2, 1, 2, 3, size, size)
    mean, log_variance = torch.randn(2, 1, 4, size // 8, size // 8)
    terms = {
        "mse": {"weight": 1.0, "term": MeanSquaredError()},
        "ssim": None,  # as good as not there
        "kl": {"weight": 1e-6, "term": KullbackLeibler()},
    }
    total, values = WeightedSum(terms)(prediction(first, Posterior(mean, log_variance)), views(second))
    theirs = DiagonalGaussianDistribution(torch.cat([mean, log_variance], dim=1)).kl().sum()
    assert set(values) == {"mse", "kl"}
    errors = (first - second).square().sum() / 2  # of one image
    assert total.item() == pytest.approx(((errors + 1e-6 * theirs) / (3 * size * size)).item(), rel=1e-5)
    assert KullbackLeibler()(prediction(first), views(second)).item() == 0  # without a posterior


class Constant:
    """A term that counts how often it is computed."""

    def __init__(self, value: float) -> None:
        self.value = value
        self.calls = 0

    def __call__(self, prediction: Prediction, truth: Views) -> torch.Tensor:
        self.calls += 1
        return torch.tensor(self.value)


@pytest.mark.parametrize(("step", "total", "names"), [(0, 0.5, {"a"}), (9, 0.5, {"a"}), (10, 6.5, {"a", "b"})])
def test_a_term_takes_part_from_its_start_step(pair, step, total, names):
    late = Constant(3.0)
    terms = {"a": {"weight": 0.5, "term": Constant(1.0)}, "b": {"weight": 2.0, "term": late, "start_step": 10}}
    result, values = WeightedSum(terms)(prediction(pair[0]), views(pair[1]), step)
    assert result.item() == pytest.approx(total)
    assert set(values) == names
    assert late.calls == ("b" in names)


@pytest.mark.parametrize("entry", [{"weight": 1.0}, {"weight": 1.0, "term": Constant(1.0), "start_setp": 5}])
def test_an_entry_without_a_term_or_with_another_key_is_refused(entry):
    with pytest.raises(CompleteSplatError, match=r"loss\.terms\.a: give weight, term and perhaps start_step"):
        WeightedSum({"a": entry})


@pytest.mark.parametrize("term", [None, {"weight": 0.0}, {"weight": 1.0, "term": Constant(1.0), "start_step": 1}])
def test_a_sum_with_nothing_at_step_zero_is_refused(term):
    with pytest.raises(CompleteSplatError, match="start_step=0"):
        WeightedSum({"a": term and {"term": Constant(1.0), **term}})


def test_training_counts_the_steps_of_the_optimizer():
    late = Constant(0.0)
    terms = {"mse": {"weight": 1.0, "term": MeanSquaredError()}, "late": {"weight": 1.0, "term": late, "start_step": 2}}
    config = compose_config("fit", "model=var", "rasterizer=reference", *NETWORKS)
    module = instantiate(config.model, _convert_="all")
    module.loss = WeightedSum(terms)
    trainer = quiet_trainer(max_steps=3, accumulate_grad_batches=2)
    trainer.fit(module, DataLoader([scene_batch()] * 8, batch_size=None, collate_fn=lambda batch: batch))
    assert (trainer.global_step, late.calls) == (3, 2)  # the batches of the third step
