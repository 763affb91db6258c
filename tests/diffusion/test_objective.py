"""Training targets, against closed forms, diffusers, and the sampler that must undo them."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler

from completesplat.diffusion.objective import PREDICTION_TYPES, target
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError

NOISE = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}


def scheduler(kind: str) -> DDIMScheduler:
    settings = {"clip_sample": False, "set_alpha_to_one": True, "timestep_spacing": "trailing"}
    return DDIMScheduler(**NOISE, **settings, prediction_type=kind)


def drawn() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    latent, noise = (torch.randn(3, 4, 2, 5, generator=generator) for _ in range(2))
    return latent, noise, torch.tensor([0, 400, 999])


def test_v_is_the_derivative_of_the_noisy_latent_along_its_circle_and_other_targets_noise_or_latent():
    """h_phi = cos(phi) h + sin(phi) eps with cos^2(phi) = alpha_bar_t has d h_phi / d phi = v."""
    latent, noise, timestep = drawn()
    assert torch.equal(target(scheduler("epsilon"), latent, noise, timestep), noise)
    assert torch.equal(target(scheduler("sample"), latent, noise, timestep), latent)
    velocity = target(scheduler("v_prediction"), latent, noise, timestep)
    torch.testing.assert_close(velocity, DDPMScheduler(**NOISE).get_velocity(latent, noise, timestep))
    betas = torch.linspace(NOISE["beta_start"] ** 0.5, NOISE["beta_end"] ** 0.5, 1000, dtype=torch.float64) ** 2
    angle = torch.cumprod(1 - betas, 0).sqrt().acos()[timestep].view(-1, 1, 1, 1)
    derivative = angle.cos() * noise.double() - angle.sin() * latent.double()
    torch.testing.assert_close(velocity.double(), derivative, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", PREDICTION_TYPES)
@pytest.mark.parametrize("steps", [1, 8, 50])
def test_a_perfect_denoiser_takes_ddim_back_to_the_latent(kind, steps):
    latent, noise, _ = drawn()
    sampler = Sampler(scheduler(kind), steps)
    # What DDIM starts from is the forward process's last state, which is not noise alone.
    start = sampler.add_noise(latent, noise, torch.full((3,), 999))

    def perfect(noisy, timestep, _):
        # On DDIM's path the noise that leads from the latent to here is always the same.
        bar = sampler.scheduler.alphas_cumprod[timestep][:, None, None, None]
        left = (noisy - bar.sqrt() * latent) / (1 - bar).sqrt()
        return target(sampler.scheduler, latent, left, timestep)

    result = sampler(perfect, start, torch.zeros(3, 1, 2, 5))
    torch.testing.assert_close(result, latent, atol=5e-5, rtol=0)


def test_another_prediction_type_is_refused_with_the_known_ones():
    latent, noise, timestep = drawn()
    other = scheduler("flow_prediction")
    with pytest.raises(CompleteSplatError, match=r"flow_prediction.*epsilon, v_prediction, sample"):
        target(other, latent, noise, timestep)
