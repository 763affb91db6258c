import pytest
import torch
from pretrained_vaes import stable_diffusion_vae

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.errors import CompleteSplatError
from completesplat.splatter_image import Parameterization

TINY = {"channels": (8, 16, 24, 32), "layers_per_block": 1, "norm_groups": 4}


def build(skip_levels: tuple[int, ...] = (0,)) -> VariationalAutoReconstructor:
    torch.manual_seed(0)
    reconstructor = Reconstructor(Parameterization(), **TINY, skip_levels=skip_levels)
    return VariationalAutoReconstructor(Encoder(**TINY), reconstructor)


@pytest.fixture(scope="module")
def images():
    return torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def test_encoder_and_reconstructor_without_skips_are_diffusers_autoencoder(images):
    model = build(skip_levels=()).eval()
    theirs = stable_diffusion_vae(**TINY, out_channels=30)
    theirs.encoder.load_state_dict(model.encoder.network.state_dict())
    theirs.quant_conv.load_state_dict(model.encoder.quant_conv.state_dict())
    theirs.decoder.load_state_dict(model.reconstructor.network.state_dict())
    theirs.post_quant_conv.load_state_dict(model.reconstructor.post_quant_conv.state_dict())
    with torch.no_grad():
        posterior, features = model.encoder(images)
        expected = theirs.encode(images * 2 - 1).latent_dist
        torch.testing.assert_close(posterior.mean, expected.mean)
        torch.testing.assert_close(posterior.log_variance, expected.logvar)
        torch.testing.assert_close(posterior.kl(), expected.kl())
        raw = model.reconstructor(posterior.mode(), features).raw
        torch.testing.assert_close(raw.flatten(1, 2), theirs.decode(expected.mean).sample)


def trained_skips(levels: tuple[int, ...]) -> VariationalAutoReconstructor:
    model = build(skip_levels=levels).eval()
    for conv in model.reconstructor.skips.values():
        torch.nn.init.normal_(conv.weight, std=0.5)
    return model


@torch.no_grad()
@pytest.mark.parametrize("levels", [(0,), (0, 1), (3,)])
def test_skips_start_at_zero_and_their_weight_acts_per_sample(images, levels):
    for model in (build(skip_levels=levels).eval(), trained_skips(levels)):
        posterior, features = model.encoder(images)
        latent = posterior.mode()
        full, none = (model.reconstructor(latent, features, weight).raw for weight in (1.0, 0.0))
        mixed = model.reconstructor(latent, features, torch.tensor([0.0, 1.0])).raw
        torch.testing.assert_close(mixed, torch.stack([none[0], full[1]]))
        assert torch.equal(full, none) == (not any(p.any() for p in model.reconstructor.skips.parameters()))
    assert (mixed[1] - none[1]).abs().max() > 1e-3


def test_a_skip_of_a_level_that_is_not_there_is_refused():
    with pytest.raises(CompleteSplatError, match=r"skip_levels=\[2\]: there are levels 0 to 1"):
        Reconstructor(Parameterization(), channels=(8, 8), norm_groups=4, skip_levels=(2,))


@torch.no_grad()
def test_features_of_the_first_levels_are_those_of_a_whole_pass(images):
    model = build(skip_levels=(0, 2)).eval()
    _, features = model.encoder(images)
    for levels in range(len(features) + 1):
        first = model.encoder.features(images * 2 - 1, levels)
        assert len(first) == levels
        assert all(map(torch.equal, first, features))
    assert model.reconstructor.feature_levels == 3
    assert build(skip_levels=()).reconstructor.feature_levels == 0


@pytest.mark.parametrize("start", [0.0, -6.0])
def test_latents_start_as_noisy_as_is_said(images, start):
    posterior, _ = Encoder((16, 32), 1, 4, 8, first_log_variance=start)(images)
    assert posterior.log_variance.mean().item() == pytest.approx(start, abs=1)
