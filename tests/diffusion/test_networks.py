import pytest
import torch

from completesplat.diffusion.denoiser import Denoiser, TextlessStableDiffusion

SMALL = {"conditioning_channels": 6, "channels": (16, 32), "attention_levels": (1,), "layers_per_block": 1}
OF_KIND = {Denoiser: {"head_channels": 8}, TextlessStableDiffusion: {"heads": 2, "context_channels": 12}}


def tiny(kind=Denoiser, **changes):
    torch.manual_seed(0)
    return kind(**(SMALL | OF_KIND[kind] | {"norm_groups": 8} | changes)).eval()


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    return torch.randn(2, 4, 8, 8), torch.tensor([10, 900]), torch.randn(2, 6, 8, 8)


@pytest.mark.parametrize("kind", OF_KIND)
@torch.no_grad()
def test_denoiser_predicts_noise_of_the_latents_shape_from_every_input(kind):
    denoiser = tiny(kind)
    latent, step, features = inputs()
    output = denoiser(latent, step, features)
    assert output.shape == latent.shape
    for changed in ((latent + 1, step, features), (latent, step - 9, features), (latent, step, features + 1)):
        assert ((denoiser(*changed) - output).abs().amax((1, 2, 3)) > 1e-4).all()
    with torch.autocast("cpu", torch.bfloat16):
        assert denoiser(latent, step, features).dtype == torch.float32


@pytest.mark.parametrize("kind", OF_KIND)
def test_recomputed_activations_give_the_same_gradients(kind, monkeypatch):
    gradients = []
    recomputed = []
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


def test_cross_attention_without_text_adds_a_constant_and_asks_nothing_where_nothing_is_trained():
    denoiser = tiny(TextlessStableDiffusion)
    added = []
    asked = []
    assert not any("context" in name for name in denoiser.state_dict())  # the token of zeros is no weight
    crossing = [module for name, module in denoiser.network.named_modules() if name.endswith("attn2")]
    assert len(crossing) == 4  # One of the way down, two of the way up, one between.
    for module in crossing:
        torch.nn.init.normal_(module.to_out[0].bias)
        module.register_forward_hook(lambda module, _, output: added.append((output, module.to_out[0].bias)))
        module.to_q.register_forward_hook(lambda *_: asked.append(1))
    trained = denoiser(*inputs())
    assert (len(asked), len(added)) == (4, 4)  # DDP waits for a gradient of every weight
    trained.sum().backward()
    assert all(parameter.grad is not None for parameter in denoiser.parameters())
    with torch.no_grad():
        drawn = denoiser(*inputs())
    assert (len(asked), len(added)) == (4, 8)
    assert all(torch.equal(output, bias.expand_as(output)) for output, bias in added[4:])
    assert torch.equal(drawn, trained)


def test_stable_diffusions_size_is_the_published_one():
    with torch.device("meta"):
        denoiser = TextlessStableDiffusion()
        without_text = Denoiser()
    count, less = (sum(p.numel() for p in network.parameters()) for network in (denoiser, without_text))
    # The published UNet (CompVis v1-inference.yaml) takes in four channels, ours eight.
    assert count == 859_520_964 + 320 * 4 * 9
    assert less < count
    for network in (denoiser, without_text):
        assert network.network.conv_in.weight.shape == (320, 8, 3, 3)
