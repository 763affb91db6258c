from contextlib import nullcontext

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError
from completesplat.viewer.panel import nearest_steps, possible_steps, square_of, square_on, square_text


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


def test_a_square_is_typed_as_the_command_takes_it_or_without_brackets():
    for text in ("0.125, 0, .5", "[0.125,0,0.5]", square_text((0.125, 0.0, 0.5))):
        assert square_of(text) == (0.125, 0.0, 0.5)
    for text in ("", "whole", "0, 1", "0, 0, 0, 1", "nan, 0, 1", "0, inf, 1"):
        with pytest.raises(CompleteSplatError, match=r"Square: .* give three numbers"):
            square_of(text)


def test_a_square_is_drawn_in_shares_of_the_photos_sides():
    html = square_on(np.zeros((50, 100, 3), np.uint8), (0.25, 0.5, 0.5))
    assert "left:25.00%;top:50.00%;width:25.00%;height:50.00%" in html
