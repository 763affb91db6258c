"""Which numbers of denoising steps a model's sampler can make."""

from diffusers import DDIMScheduler

from completesplat.diffusion.sampling import Sampler

MOST_STEPS = 100


def possible_steps(sampler: Sampler) -> list[int]:
    """Up to 100, and the sampler's own number: DDIM's must divide the number of noise levels."""
    numbers = range(1, min(MOST_STEPS, sampler.training_timesteps) + 1)
    divides = isinstance(sampler.scheduler, DDIMScheduler)
    found = {n for n in numbers if not (divides and sampler.training_timesteps % n)}
    return sorted(found | {sampler.steps})


def nearest_steps(sampler: Sampler, steps: int) -> int:
    """The possible number that is nearest, the smaller of two."""
    return min(possible_steps(sampler), key=lambda n: abs(n - steps))
