import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler

from completesplat.diffusion.sampling import Sampler

NOISE = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
DDIM = NOISE | {"clip_sample": False, "set_alpha_to_one": False, "timestep_spacing": "trailing"}


@pytest.fixture
def sampler():
    return Sampler(DDIMScheduler(**DDIM))


def alpha_bar() -> torch.Tensor:
    """Eq. 2's product, from the scaled-linear schedule's own definition."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    return torch.cumprod(1 - betas, 0)


def test_forward_noising_is_equation_two_and_diffusers(sampler):
    torch.manual_seed(0)
    latent, noise = torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2)
    step = torch.tensor([0, 500, 999])
    noisy = sampler.add_noise(latent, noise, step)
    bar = alpha_bar()[step].view(-1, 1, 1, 1).float()
    torch.testing.assert_close(noisy, bar.sqrt() * latent + (1 - bar).sqrt() * noise, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(noisy, DDPMScheduler(**NOISE).add_noise(latent, noise, step))


def test_one_step_is_ddims_equation(sampler):
    """DDIM (Song et al. 2021, Eq. 12, sigma = 0): from t = 999 straight to the clean latent's end of the chain."""
    torch.manual_seed(0)
    noise, predicted = torch.randn(2, 4, 2, 2), torch.randn(2, 4, 2, 2)
    result = sampler(lambda *_: predicted, noise, torch.zeros(2, 1, 2, 2), steps=1)
    last, first = alpha_bar()[999].float(), alpha_bar()[0].float()
    clean = (noise - (1 - last).sqrt() * predicted) / last.sqrt()
    torch.testing.assert_close(result, first.sqrt() * clean + (1 - first).sqrt() * predicted, atol=1e-4, rtol=1e-4)


def exact_denoiser(mean: float, std: float, scheduler):
    """The best noise prediction for latents N(mean, std^2): E[eps | h_t] in closed form."""

    def denoise(latent, timestep, conditioning):
        bar = scheduler.alphas_cumprod[timestep.long()].view(-1, 1, 1, 1)
        variance = bar * std**2 + 1 - bar
        return (1 - bar).sqrt() * (latent - bar.sqrt() * mean) / variance

    return denoise


@pytest.mark.parametrize("scheduler", [DDIMScheduler(**DDIM), DPMSolverMultistepScheduler(**NOISE)])
def test_an_exact_denoiser_gives_the_data_distribution(scheduler):
    noise = torch.randn(2000, 1, 4, 4, generator=torch.Generator().manual_seed(0))
    sampler = Sampler(scheduler, steps=50)
    drawn = sampler(exact_denoiser(0.7, 0.5, scheduler), noise, torch.zeros(2000, 1, 4, 4))
    assert abs(drawn.mean() - 0.7) < 0.03
    assert abs(drawn.std() - 0.5) < 0.03


def test_the_default_is_fifty_steps(sampler):
    calls = []
    sampler(lambda x, t, c: calls.append(t[0].item()) or x * 0, torch.zeros(1, 1, 2, 2), torch.zeros(1, 1, 2, 2))
    assert calls == list(range(999, 18, -20))


def test_the_result_depends_on_the_noise_alone(sampler):
    noise, features = torch.randn(2, 1, 2, 2), torch.randn(2, 1, 2, 2)
    denoise = exact_denoiser(0.0, 1.0, sampler.scheduler)
    torch.testing.assert_close(sampler(denoise, noise, features), sampler(denoise, noise, features), rtol=0, atol=0)
