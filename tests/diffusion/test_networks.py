import pytest
import torch

from completesplat.diffusion.conditioning import LearnedConditioning
from completesplat.diffusion.denoiser import Denoiser, TextlessStableDiffusion

SMALL = {"conditioning_channels": 6, "channels": (16, 32), "attention_levels": (1,), "layers_per_block": 1}
OF_KIND = {Denoiser: {"head_channels": 8}, TextlessStableDiffusion: {"heads": 2, "context_channels": 12}}


def tiny(kind=Denoiser, **changes):
    torch.manual_seed(0)
    return kind(**(SMALL | OF_KIND[kind] | {"norm_groups": 8} | changes)).eval()


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    return torch.randn(2, 4, 8, 8), torch.tensor([10, 900]), torch.randn(2, 6, 8, 8)


def parameters(network: torch.nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def test_conditioning_has_the_latents_resolution():
    network = LearnedConditioning(out_channels=6, channels=(8, 8, 16, 16), norm_groups=4)
    assert network(torch.rand(2, 3, 64, 48)).shape == (2, 6, 8, 6)


@pytest.mark.parametrize("kind", OF_KIND)
def test_denoiser_predicts_noise_of_the_latents_shape_from_every_input(kind):
    denoiser = tiny(kind)
    latent, step, features = inputs()
    with torch.no_grad():
        output = denoiser(latent, step, features)
        assert output.shape == latent.shape
        for changed in (
            denoiser(latent + 1, step, features),
            denoiser(latent, step - 9, features),
            denoiser(latent, step, features + 1),
        ):
            assert ((changed - output).abs().amax((1, 2, 3)) > 1e-4).all()
        with torch.autocast("cpu", torch.bfloat16):
            assert denoiser(latent, step, features).dtype == torch.float32


@pytest.mark.parametrize("kind", OF_KIND)
def test_recomputed_activations_give_the_same_gradients(kind, monkeypatch):
    gradients, recomputed = [], []
    run = torch.utils.checkpoint.checkpoint
    monkeypatch.setattr(torch.utils.checkpoint, "checkpoint", lambda *a, **k: recomputed.append(1) or run(*a, **k))
    for checkpointing in (False, True):
        denoiser = tiny(kind, gradient_checkpointing=checkpointing).train()
        denoiser(*inputs()).square().mean().backward()
        gradients.append({name: p.grad for name, p in denoiser.named_parameters()})
        assert bool(recomputed) == checkpointing
    assert gradients[0].keys() == gradients[1].keys()
    for name, expected in gradients[0].items():
        torch.testing.assert_close(gradients[1][name], expected, msg=name)


def test_cross_attention_without_text_adds_a_constant():
    denoiser = tiny(TextlessStableDiffusion)
    assert not any("context" in name for name in denoiser.state_dict())  # the token of zeros is no weight
    crossing = [module for name, module in denoiser.network.named_modules() if name.endswith("attn2")]
    assert len(crossing) == 4  # One of the way down, two of the way up, one between.
    added = []
    for module in crossing:
        torch.nn.init.normal_(module.to_out[0].bias)
        module.register_forward_hook(lambda module, _, output: added.append((output, module.to_out[0].bias)))
    with torch.no_grad():
        denoiser(*inputs())
    assert len(added) == 4
    assert all(torch.equal(output, bias.expand_as(output)) for output, bias in added)


def conv(inputs: int, outputs: int, size: int = 3) -> int:
    return size**2 * inputs * outputs + outputs


def resnet(inputs: int, outputs: int, time: int = 1280) -> int:
    """Two normalised convolutions, a projection of the time in between, and one past them where widths differ."""
    past = 0 if inputs == outputs else conv(inputs, outputs, 1)
    return 2 * inputs + conv(inputs, outputs) + conv(time, outputs, 1) + 2 * outputs + conv(outputs, outputs) + past


def transformer(c: int, context: int = 768) -> int:
    """Self-attention, cross-attention and a gated feed-forward layer of four times the width, each normalised."""
    out = c * c + c
    feed_forward = c * 8 * c + 8 * c + 4 * c * c + c
    return 2 * c + conv(c, c, 1) + 3 * 2 * c + (3 * c * c + out) + (c * c + 2 * context * c + out) + feed_forward + out


def stable_diffusion_parameters(inputs: int) -> int:
    """Stable Diffusion 1's UNet, from CompVis v1-inference.yaml: width 320, times (1, 2, 4, 4), two blocks a level.

    All levels but the last have attention, after each of their blocks; the way up has a block more, which takes in what
    the way down left at its place.
    """
    widths, total = [320, 640, 1280, 1280], conv(320, 1280, 1) + conv(1280, 1280, 1) + conv(inputs, 320)
    left, width = [320], 320
    for level, wide in enumerate(widths):
        for _ in range(2):
            total += resnet(width, wide) + (transformer(wide) if level < 3 else 0)
            width = wide
            left.append(wide)
        if level < 3:
            total += conv(wide, wide)
            left.append(wide)
    total += 2 * resnet(1280, 1280) + transformer(1280)
    for level, wide in reversed(list(enumerate(widths))):
        for _ in range(3):
            total += resnet(width + left.pop(), wide) + (transformer(wide) if level < 3 else 0)
            width = wide
        total += conv(wide, wide) if level > 0 else 0
    return total + 2 * 320 + conv(320, 4)


def test_stable_diffusions_size_is_the_published_one():
    with torch.device("meta"):
        denoiser, without_text = TextlessStableDiffusion(), Denoiser()
    # 859.52 M is the size of Stable Diffusion 1's UNet; four more input channels have 320 * 4 * 9 weights.
    assert stable_diffusion_parameters(inputs=4) == pytest.approx(859.52e6, abs=5e3)
    assert parameters(denoiser) == stable_diffusion_parameters(inputs=8)
    assert parameters(denoiser) - stable_diffusion_parameters(inputs=4) == 320 * 4 * 9
    for network in (denoiser, without_text):
        assert network.network.conv_in.weight.shape == (320, 8, 3, 3)
    assert parameters(without_text) < parameters(denoiser)
