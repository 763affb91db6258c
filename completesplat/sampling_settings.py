"""Settings of the scenes that a model makes of one image, and what it calls while it makes them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from completesplat.gaussians import Gaussians
from completesplat.quantities import Natural, Positive, Seed

OnScenes = Callable[[int, int, Gaussians], None]
"""Callback: (number of the denoiser call, timestep, scenes as they are estimated now) -> None."""
OnFit = Callable[[int], None]
"""Callback: (number of the sample) -> None."""
COLOR_FITS = 40
"""Default number of rounds of fitting a photo's scenes to it, at the model's size; `Sampling` has the paper's, 0."""
DETAIL = 512
"""Default of the largest side, in pixels, of the image that a scene's front is fitted to."""


@dataclass(frozen=True)
class Sampling:
    """Settings of the scenes that a model makes of one image.

    Models that draw no samples use only `samples`, which must be 1, and `color_fits`.

    Attributes:
        samples: number of scenes of each image.
        steps: denoising steps; by default the sampler's number.
        guidance_weight: share of the unconditional prediction; more gives more diverse samples.
        skip_weight: default 1, the most faithful (supplement, "Diverse Sampling"), or 0 if something is hidden.
        seed: seed of all noise, or one for each image, whose samples then do not depend on the other images.
        color_fits: rounds of fitting to the image at the model's size (`fit_front`); 0 in the paper.
        batch: the largest number of latents at a time; it changes only rounding. By default all, or fewer if a GPU's
            memory does not suffice. On a CPU, a small denoiser takes as many at a time as `part_of` returns, unless
            `on_step` is given.
        bfloat16: compute the denoiser in bfloat16; a call with a photo does, where the device computes in it. Renders
            then change about as little as by rounding to 8 bits.
    """

    samples: Positive = 1
    steps: int | None = None
    guidance_weight: float = 0.0
    skip_weight: float | None = None
    seed: Seed | Sequence[Seed] = 0
    color_fits: Natural = 0
    batch: Positive | None = None
    bfloat16: bool = False


DEFAULT_SAMPLING = Sampling()
