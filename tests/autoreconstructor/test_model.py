import pytest
import torch
from diffusers import AutoencoderKL

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.splatter_image import Parameterization

TINY = {"channels": (8, 16, 24, 32), "layers_per_block": 1, "norm_groups": 4}


def build(skip_levels: tuple[int, ...] = (0,), **settings) -> VariationalAutoReconstructor:
    torch.manual_seed(0)
    shape = TINY | settings
    return VariationalAutoReconstructor(
        Encoder(**shape), Reconstructor(Parameterization(), **shape, skip_levels=skip_levels)
    )


@pytest.fixture(scope="module")
def images():
    return torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def test_encoder_and_reconstructor_without_skips_are_diffusers_autoencoder(images):
    model = build(skip_levels=()).eval()
    theirs = AutoencoderKL(
        out_channels=30,
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=TINY["channels"],
        layers_per_block=TINY["layers_per_block"],
        norm_num_groups=TINY["norm_groups"],
    ).eval()
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


def test_stable_diffusions_sizes_have_its_parameter_count():
    with torch.device("meta"):
        encoder = Encoder()
        reconstructor = Reconstructor(Parameterization(), skip_levels=())
    count = sum(p.numel() for module in (encoder, reconstructor) for p in module.parameters())
    # 83,653,863 of AutoencoderKL, its 3-channel output convolution (3,459) widened to 30 channels (34,590).
    assert count == 83_653_863 - 3_459 + 34_590


def test_skips_start_at_zero_and_leave_the_decoder_intact(images):
    torch.manual_seed(0)
    model = build(skip_levels=(0, 1)).eval()
    posterior, features = model.encoder(images)
    full = model.reconstructor(posterior.mode(), features, 1.0).raw
    none = model.reconstructor(posterior.mode(), features, 0.0).raw
    torch.testing.assert_close(full, none, rtol=0, atol=0)


def trained_skips(levels: tuple[int, ...]) -> VariationalAutoReconstructor:
    model = build(skip_levels=levels).eval()
    for conv in model.reconstructor.skips.values():
        torch.nn.init.normal_(conv.weight, std=0.5)
    return model


@pytest.mark.parametrize("levels", [(0,), (1,), (0, 1), (3,)])
def test_skip_weight_acts_per_sample(images, levels):
    model = trained_skips(levels)
    with torch.no_grad():
        posterior, features = model.encoder(images)
        latent = posterior.mode()
        mixed = model.reconstructor(latent, features, torch.tensor([0.0, 1.0])).raw
        torch.testing.assert_close(mixed[0], model.reconstructor(latent, features, 0.0).raw[0])
        torch.testing.assert_close(mixed[1], model.reconstructor(latent, features, 1.0).raw[1])
        assert (mixed[1] - model.reconstructor(latent, features, 0.0).raw[1]).abs().max() > 1e-3


def test_evaluation_draws_nothing_and_training_samples_the_posterior(images):
    model = trained_skips((0,)).eval()
    with torch.no_grad():
        first, second = model(images), model(images)
        torch.testing.assert_close(first.splatter_image.raw, second.splatter_image.raw, rtol=0, atol=0)
        model = build().train()
        first, second = model(images), model(images)
    assert (first.splatter_image.raw - second.splatter_image.raw).abs().max() > 1e-4
