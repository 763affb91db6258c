import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError
from completesplat.viewer.controls import nearest_steps, possible_steps


@pytest.mark.parametrize(
    "scheduler", [DDIMScheduler(), DDIMScheduler(num_train_timesteps=30), DPMSolverMultistepScheduler()]
)
def test_the_sampler_takes_just_these_numbers(scheduler):
    sampler = Sampler(scheduler, steps=2)
    noise, conditioning = torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)

    def taken(steps: int) -> bool:
        try:
            sampler(lambda latent, *_: torch.zeros_like(latent), noise, conditioning, steps=steps)
        except CompleteSplatError:
            return False
        return True

    asked = [1, 2, 3, 4, 7, 10, 15, 20, 30, 31, 40]
    assert [n for n in asked if taken(n)] == [n for n in asked if n in possible_steps(sampler)]


def test_the_nearest_possible_number():
    sampler = Sampler(DDIMScheduler(), steps=50)
    assert [nearest_steps(sampler, n) for n in (1, 11, 23, 30, 70, 100)] == [1, 10, 25, 25, 50, 100]


def test_the_samplers_own_number_is_always_there():
    assert 500 in possible_steps(Sampler(DDIMScheduler(), steps=500))
