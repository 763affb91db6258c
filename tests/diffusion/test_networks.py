import torch

from completesplat.diffusion.conditioning import LearnedConditioning
from completesplat.diffusion.denoiser import Denoiser


def tiny(**changes) -> Denoiser:
    torch.manual_seed(0)
    settings = {"conditioning_channels": 6, "channels": (16, 32), "attention_levels": (1,), "layers_per_block": 1}
    return Denoiser(**(settings | {"head_channels": 8, "norm_groups": 8} | changes)).eval()


def test_conditioning_has_the_latents_resolution():
    network = LearnedConditioning(out_channels=6, channels=(8, 8, 16, 16), norm_groups=4)
    assert network(torch.rand(2, 3, 64, 48)).shape == (2, 6, 8, 6)


def test_denoiser_predicts_noise_of_the_latents_shape_from_every_input():
    denoiser = tiny()
    torch.manual_seed(1)
    latent, features, step = torch.randn(2, 4, 8, 8), torch.randn(2, 6, 8, 8), torch.tensor([10, 900])
    with torch.no_grad():
        output = denoiser(latent, step, features)
        assert output.shape == latent.shape
        for changed in (
            denoiser(latent + 1, step, features),
            denoiser(latent, step - 9, features),
            denoiser(latent, step, features + 1),
        ):
            assert ((changed - output).abs().amax((1, 2, 3)) > 1e-4).all()


def test_stable_diffusions_sizes_without_cross_attention():
    with torch.device("meta"):
        denoiser = Denoiser()
    count = sum(p.numel() for p in denoiser.parameters())
    # Stable Diffusion 1 with 8 input channels has 859.5 M parameters, about 44 M of them in cross-attention; its
    # transformer blocks' feed-forward layers are absent from plain self-attention blocks too.
    assert 600e6 < count < 820e6
    assert denoiser.network.conv_in.weight.shape == (320, 8, 3, 3)
