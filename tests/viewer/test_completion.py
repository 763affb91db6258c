from contextlib import nullcontext

import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError
from completesplat.viewer.panel import nearest_steps, possible_steps


@pytest.mark.parametrize("scheduler", [DDIMScheduler(num_train_timesteps=30), DPMSolverMultistepScheduler()])
def test_the_sampler_takes_just_these_numbers(scheduler):
    sampler, nothing = Sampler(scheduler, steps=2), torch.zeros(1, 1, 1, 1)
    possible = possible_steps(sampler)
    for steps in (1, 2, 3, 4, 7, 10, 15, 20, 30, 31, 40):
        with nullcontext() if steps in possible else pytest.raises(CompleteSplatError):
            sampler(lambda latent, *_: torch.zeros_like(latent), nothing, nothing, steps=steps)


def test_the_nearest_possible_number():
    sampler = Sampler(DDIMScheduler(), steps=50)
    assert [nearest_steps(sampler, n) for n in (1, 11, 23, 30, 70, 100)] == [1, 10, 25, 25, 50, 100]
    assert 500 in possible_steps(Sampler(DDIMScheduler(), steps=500))
