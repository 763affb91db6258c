"""What drawing scenes costs, from the pictures to the Gaussians: in batches, with guidance, in few steps."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch

from completesplat.diffusion.sampling import Sampler
from completesplat.gaussians import Gaussians
from completesplat.generation import CompleteSplat
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.reports.diffusion.comparing import Comparison

GUIDANCE_WEIGHT = 0.5  # of the paper's settings for diverse samples
MANY_STEPS = 50  # the paper's


def comparisons(model: CompleteSplat, few: Mapping[str, Any], samples: int, steps: int, batch: int) -> list[Comparison]:
    """Of a generator on its device.

    Args:
        few: configuration of a sampler with few steps.
        samples: of one picture, in a batch or one by one.
        steps: of those samples.
        batch: pictures, of which a sample each is drawn without and with guidance, and in few and in many steps.
    """
    model.eval()
    usual, quick = model.sampler, _built(model, few)
    several = partial(_draw, model, usual, 1, steps=steps, samples=samples)
    draw = partial(_draw, model, usual, batch)
    return [
        Comparison(
            f"batch_vs_one_by_one_k{samples}",
            (f"{samples} samples at a time", several),
            ("one by one", partial(several, batch=1)),
        ),
        Comparison(
            "unguided_vs_guided",
            ("w = 0", draw),
            (f"w = {GUIDANCE_WEIGHT}", partial(draw, guidance_weight=GUIDANCE_WEIGHT)),
        ),
        Comparison(
            f"few_steps_vs_{MANY_STEPS}",
            (_named(quick, quick.steps), partial(_draw, model, quick, batch)),
            (_named(usual, MANY_STEPS), partial(draw, steps=MANY_STEPS)),
        ),
    ]


def _built(model: CompleteSplat, sampler: Mapping[str, Any]) -> Sampler:
    """The sampler of a configuration, for what the model's denoiser was trained with."""
    own, config = model.sampler, model.architecture["sampler"]
    model.replace_sampler(sampler)
    built = model.sampler
    model.sampler, model.architecture["sampler"] = own, config
    return built


def _draw(model: CompleteSplat, sampler: Sampler, pictures: int, **settings: Any) -> Gaussians:
    """Scenes of pictures of noise: what they show does not change the work."""
    size, device = model.image_size, model.latent_scale.device
    images = torch.rand(pictures, 3, size, size, generator=torch.Generator().manual_seed(0)).to(device)
    camera = Cameras(torch.eye(4, device=device), pinhole(model.fov_degrees.item(), size).to(device), (size, size))
    cameras = camera.map(lambda tensor: tensor.expand(pictures, *tensor.shape))
    model.sampler = sampler
    return model.generate(images, cameras, model.depth_range.expand(pictures, 2), **settings)


def _named(sampler: Sampler, steps: int) -> str:
    name = type(sampler.scheduler).__name__.removesuffix("Scheduler").removesuffix("Multistep")
    return f"{name}, {steps} step{'' if steps == 1 else 's'}"
