"""The scene's code: an encoder learns it with the denoiser, a prior draws it, noise alone decides the draw."""

import pytest
import torch
from support import tiny_generator
from torch import nn

from completesplat.diffusion.scene_code import SceneCode


@pytest.fixture(scope="module")
def trained() -> SceneCode:
    """A code beside a denoiser at full noise, which sees phi_ref with the code alone and predicts the latent."""
    torch.manual_seed(0)
    code = SceneCode(1, 4, length=1, values=4)
    denoiser = nn.Sequential(nn.Conv2d(4, 64, 1), nn.SiLU(), nn.Conv2d(64, 1, 1))
    optimizer = torch.optim.Adam([*code.parameters(), *denoiser.parameters()], 3e-3)
    for _ in range(150):
        latent, conditioning, _ = scenes(32)
        known, code_loss, _ = code(latent, conditioning)
        loss = (denoiser(known) - latent[:, :, :1, :1]).square().mean() + code_loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return code


def scenes(count):
    """Latents of mode 0 or 1, and phi_ref, whose first channel says which of them has a probability of 0.8."""
    likely = torch.rand(count) < 0.5
    mode = torch.where(torch.rand(count) < 0.8, likely, ~likely)
    conditioning = torch.randn(count, 4, 4, 4) * 0.1
    conditioning[:, 0] += likely[:, None, None].float() - 0.5
    latent = 0.05 * torch.randn(count, 1, 4, 4)
    latent[:, :, :2] += 2.0 * mode.view(-1, 1, 1, 1) - 1
    return latent, conditioning, mode.long()


def codes_of(code, features, conditioning):
    """Numbers of the codes that were added to phi_ref."""
    added = (features - conditioning)[:, :, 0, 0]
    return torch.cdist(added, code.embedding[0]).argmin(1)


def test_each_mode_has_codes_of_its_own_and_the_prior_knows_their_probabilities(trained):
    torch.manual_seed(1)
    latent, conditioning, mode = scenes(1000)
    with torch.no_grad():
        encoded = codes_of(trained, trained(latent, conditioning)[0], conditioning)
        likeliest = codes_of(trained, trained.encoded(latent, conditioning), conditioning)
        drawn = codes_of(trained, trained.drawn(conditioning, torch.randn(1000, 1, 4, 4)), conditioning)
    counts = torch.stack([torch.bincount(mode[encoded == value], minlength=2) for value in range(4)])
    assert counts.amax(1).sum() > 970
    mode_of = counts.argmax(1)
    assert (mode_of[likeliest] == mode).float().mean() > 0.98
    as_expected = mode_of[drawn] == (conditioning[:, 0].mean((1, 2)) > 0)
    assert as_expected.float().mean().item() == pytest.approx(0.8, abs=0.05)


def test_what_a_code_tells_is_its_divergence_from_the_prior_and_phi_ref_is_left_alone():
    code = SceneCode(1, 4, length=2, values=3)
    latent, conditioning, _ = scenes(3)
    conditioning.requires_grad_()
    _, loss, told = code(latent, conditioning)
    loss.backward()
    assert conditioning.grad is None
    assert all(p.grad.abs().sum() > 0 for p in [*code.encoder.parameters(), *code.prior.parameters()] if p.ndim > 1)
    with torch.no_grad():
        logits = (
            code.encoder(torch.cat([latent, conditioning], 1)).view(3, 2, 3),
            code.prior(conditioning).view(3, 2, 3),
        )
    kinds = [torch.distributions.Categorical(logits=x) for x in logits]
    torch.testing.assert_close(told, torch.distributions.kl_divergence(*kinds).mean())


def test_samples_depend_on_their_own_noise_alone(trained):
    conditioning = scenes(6)[1]
    noise = torch.randn(6, 1, 4, 4)
    with torch.no_grad():
        together = trained.drawn(conditioning, noise)
        apart = torch.cat([trained.drawn(conditioning[i : i + 1], noise[i : i + 1]) for i in range(6)])
    torch.testing.assert_close(together, apart)


def test_a_generator_draws_with_its_code_and_keeps_it_in_its_files(tmp_path):
    model = tiny_generator("denoiser.code_length=2", "denoiser.code_values=4")
    image = torch.rand(3, model.image_size, model.image_size)
    plain = model(image, samples=2, steps=2)
    model.save_pretrained(tmp_path)
    loaded = type(model).from_pretrained(tmp_path)
    assert torch.equal(loaded(image, samples=2, steps=2)[1].colors, plain[1].colors)
    with torch.no_grad():
        model.denoiser.code.embedding.add_(torch.randn_like(model.denoiser.code.embedding))
    assert not torch.equal(model(image, samples=2, steps=2)[1].colors, plain[1].colors)
