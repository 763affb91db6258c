"""The frozen encoder of Stable Diffusion's VAE as the conditioning."""

import pytest
import torch
from pretrained_vaes import SHAPE, random_vae, rewrite
from support import tiny_generator

from completesplat.diffusion.conditioning import LearnedConditioning, StableDiffusionConditioning
from completesplat.errors import WeightsError
from completesplat.generator import CompleteSplat


@pytest.fixture(scope="module")
def vae():
    return random_vae()


@pytest.fixture(scope="module")
def folder(vae, tmp_path_factory):
    path = tmp_path_factory.mktemp("vae")
    vae.save_pretrained(path)
    return path


@torch.no_grad()
@pytest.mark.parametrize("whole", [True, False])
def test_features_are_the_vaes_mean_times_its_scale(vae, tmp_path, whole):
    """The decoder need not be there."""
    vae.save_pretrained(tmp_path)
    if not whole:
        rewrite(tmp_path, lambda weights: [weights.pop(name) for name in list(weights) if "decoder" in name])
    images = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(2))
    features = StableDiffusionConditioning(str(tmp_path), **SHAPE)(images)
    assert features.shape == (2, 4, 4, 6)
    torch.testing.assert_close(features, vae.encode(images * 2 - 1).latent_dist.mean * 0.18215)


def test_it_is_frozen_and_stays_in_evaluation_mode():
    conditioning = StableDiffusionConditioning(**SHAPE)
    assert conditioning.frozen
    assert not LearnedConditioning.frozen
    torch.nn.ModuleList([conditioning]).train()
    assert not any(module.training for module in conditioning.modules())
    assert not any(p.requires_grad for p in conditioning.parameters())
    assert not conditioning(torch.rand(1, 3, 16, 16, requires_grad=True)).requires_grad


@pytest.mark.parametrize(
    ("change", "reason", "setting"),
    [
        ({"channels": (8, 8, 8, 8)}, "there and [8, ", "conditioning.channels=[8,8,16,16]"),
        ({"out_channels": 8}, "there and [16, ", "conditioning.out_channels=4"),
        ({"norm_groups": 8}, "4 groups, not 8", "conditioning.norm_groups=4"),
    ],
)
def test_another_size_names_the_conditionings_settings(folder, change, reason, setting):
    with pytest.raises(WeightsError) as caught:
        StableDiffusionConditioning(str(folder), **(SHAPE | change))
    assert reason in str(caught.value)
    assert setting in str(caught.value)
    assert "autoreconstructor." not in str(caught.value)


def test_a_saved_generator_holds_the_weights_and_needs_no_vae(folder, tmp_path):
    parts = dict(tiny_generator().architecture)
    target = "completesplat.diffusion.conditioning.StableDiffusionConditioning"
    shape = SHAPE | {"channels": list(SHAPE["channels"])}
    parts["conditioning"] = {"_target_": target, "pretrained": str(folder), **shape}
    parts["denoiser"] = parts["denoiser"] | {"conditioning_channels": 4}
    CompleteSplat(**parts).save_pretrained(tmp_path / "weights")
    assert parts["conditioning"]["pretrained"] == str(folder)
    loaded = CompleteSplat.from_pretrained(tmp_path / "weights")
    assert loaded.architecture["conditioning"]["pretrained"] is None
    images = torch.rand(1, 3, 32, 32)
    assert torch.equal(loaded.conditioning(images), StableDiffusionConditioning(str(folder), **SHAPE)(images))
