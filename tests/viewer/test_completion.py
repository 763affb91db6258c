import io
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler
from PIL import Image
from support import tiny_generator

from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError, ImageError
from completesplat.viewer.completion import read_upload
from completesplat.viewer.panel import nearest_steps, possible_steps


@pytest.fixture(scope="module")
def model():
    return tiny_generator()


def png(width: int, height: int, mode: str = "RGB") -> bytes:
    color = 200 if mode == "1" else (200, 100, 50)
    Image.new(mode, (width, height), color).save(buffer := io.BytesIO(), "PNG")
    return buffer.getvalue()


def test_an_image_is_read_at_the_models_size(model):
    photograph = read_upload(model, "a.png", png(50, 40))
    assert photograph.image.shape == (3, 32, 32)
    assert photograph.image[:, 5, 5].numpy() == pytest.approx(np.array([200, 100, 50]) / 255, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("notes.txt", png(50, 40)[:60], "^notes.txt: "),
        ("../../\n\x1betc/passwd", b"nothing", r"^\.\./\.\./\\n\\x1betc/passwd: not an image"),  # no path, no markup
        ("bomb.png", png(8000, 8000, "1"), "64,000,000|8000 x 8000"),  # some kilobytes
    ],
)
def test_other_files_and_too_many_pixels_are_refused_by_file_name(model, name, content, message):
    with pytest.raises(ImageError, match=message):
        read_upload(model, name, content)


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
