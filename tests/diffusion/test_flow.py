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


def test_an_exact_denoiser_gives_the_data_distribution():
    """Data with two modes, of which one is three times as probable: shares, means and deviations of both."""
    modes = torch.tensor([-2.0, 1.0])
    shares = torch.tensor([0.25, 0.75])
    std = 0.1

    def velocity(noisy, time, conditioning):
        t = (time[0] / 1000).clamp(max=0.9999).double()
        spread = ((1 - t) * std) ** 2 + t**2
        distance = noisy.double()[..., None] - (1 - t) * modes
        weight = (shares.log() - distance**2 / (2 * spread)).softmax(-1)
        clean = (weight * (modes + (1 - t) * std**2 / spread * distance)).sum(-1)
        return ((noisy - clean) / t).float()

    sampler = Sampler(FlowMatchEulerDiscreteScheduler(), steps=200)
    noise = torch.randn(2, 1, 100, 100, generator=torch.Generator().manual_seed(0))
    drawn = sampler(velocity, noise, noise).flatten()
    left = drawn < -0.5
    assert left.double().mean().item() == pytest.approx(0.25, abs=0.015)
    for mode, result in zip(modes, (drawn[left], drawn[~left]), strict=True):
        assert result.mean().item() == pytest.approx(mode.item(), abs=0.01)
        assert result.std().item() == pytest.approx(std, abs=0.01)


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
