"""Flow matching: `sampler=flow25` and its training."""

import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from completesplat.diffusion.objective import clean_estimate, target
from completesplat.diffusion.sampling import Sampler, with_forward_process
from completesplat.errors import CompleteSplatError

CLEAN = torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(1))
NOISE = torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(2))


@pytest.fixture
def sampler():
    return Sampler(FlowMatchEulerDiscreteScheduler(), steps=5)


def test_noisy_latents_lie_on_the_line_from_latent_to_noise(sampler):
    time = torch.tensor([250, 1000])
    noisy = sampler.add_noise(CLEAN, NOISE, time)
    torch.testing.assert_close(noisy[0], 0.75 * CLEAN[0] + 0.25 * NOISE[0])
    torch.testing.assert_close(noisy[1], NOISE[1])


def test_the_target_is_the_velocity_and_gives_the_latent_back(sampler):
    time = torch.tensor([400, 400])
    velocity = target(sampler.scheduler, CLEAN, NOISE, time)
    torch.testing.assert_close(velocity, NOISE - CLEAN)
    noisy = sampler.add_noise(CLEAN, NOISE, time)
    torch.testing.assert_close(clean_estimate(sampler.scheduler, noisy, velocity, time[0]), CLEAN)


@pytest.mark.parametrize("steps", [1, 5, 30])
def test_a_perfect_denoiser_takes_noise_to_the_latent_in_any_number_of_steps(sampler, steps):
    calls = []

    def velocity(noisy, time, conditioning):
        calls.append(time[0].item())
        return (noisy - CLEAN) / (time / 1000).view(-1, 1, 1, 1)

    torch.testing.assert_close(sampler(velocity, NOISE, NOISE, steps=steps), CLEAN, atol=1e-3, rtol=1e-3)
    assert calls == [round(1000 * (1 - i / steps)) for i in range(steps)]


def test_training_favours_the_middle_of_the_way(sampler):
    torch.manual_seed(0)
    drawn = sampler.draw_timesteps(20_000, torch.device("cpu"))
    assert drawn.min() >= 1
    assert drawn.max() <= 1000
    # The logistic of a standard normal: P(t < 0.2) = P(z < log(0.2 / 0.8)) = 0.0828.
    assert (drawn <= 200).double().mean().item() == pytest.approx(0.0828, abs=0.008)
    assert drawn.double().mean().item() == pytest.approx(500, abs=5)


def test_samplers_of_diffusion_and_of_flow_do_not_draw_from_each_others_denoisers():
    flow = {"scheduler": {"_target_": "diffusers.FlowMatchEulerDiscreteScheduler"}, "steps": 5}
    ddim = {"scheduler": {"_target_": "diffusers.DDIMScheduler", "beta_end": 0.02}, "steps": 5}
    assert with_forward_process(flow | {"steps": 9}, flow)["steps"] == 9
    for one, other in ((flow, ddim), (ddim, flow)):
        with pytest.raises(CompleteSplatError, match="cannot draw"):
            with_forward_process(one, other)
