"""Samplers as tables of numbers, for programs without diffusers."""

from typing import Any

import torch

from completesplat.diffusion.objective import is_flow
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError

NOT_LINEAR = ("clip_sample", "thresholding")


def step_table(sampler: Sampler) -> dict[str, Any]:
    """Return the calls of the denoiser that a sampler makes, and the latent that comes out.

    Every latent of a deterministic scheduler is a weighted sum of the noise and of the predictions so far. The weights
    are measured: the scheduler takes its steps on unit vectors in place of latents.

    Returns:
        `calls`: for each call its `timestep`, and `input`, the weights of the noise and of each earlier prediction in
        the denoiser's input. `latent`: these weights in the result.

    Raises:
        CompleteSplatError: the scheduler clips latents, so that its steps are not sums.
    """
    scheduler = sampler.set_up()
    for name in NOT_LINEAR:
        if scheduler.config.get(name):
            raise CompleteSplatError(f"{name}=true: a table of steps cannot say this; choose another sampler")
    count = len(scheduler.timesteps)
    units = torch.eye(count + 1)
    flow = is_flow(scheduler)
    latent = units[0] if flow else units[0] * scheduler.init_noise_sigma
    calls = []
    for number, timestep in enumerate(scheduler.timesteps):
        inputs = latent if flow else scheduler.scale_model_input(latent, timestep)
        calls.append({"timestep": int(timestep.round()), "input": inputs[: number + 1].tolist()})
        latent = scheduler.step(units[number + 1], timestep, latent).prev_sample
    return {"calls": calls, "latent": latent.tolist()}
