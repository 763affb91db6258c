"""Sampling of latents with a denoiser and a diffusers scheduler, in parts that fit into memory."""

import copy
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from diffusers import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor, nn

from completesplat.diffusion.denoiser import Conditioning, Denoise, Latents
from completesplat.diffusion.guidance import guided_noise
from completesplat.diffusion.objective import clean_estimate, is_flow, signal_and_noise
from completesplat.errors import CompleteSplatError
from completesplat.quantities import Range

T = TypeVar("T")
logger = logging.getLogger(__name__)

SMALL = 20_000_000
"""Parameters of a denoiser below which samples are drawn side by side (notebooks/experiments.md)."""
PART = 4
LARGEST_PART = 10
"""Fewest and most samples that a thread draws at a time with a small denoiser; a thread decodes `PART` at a time."""

_callers: list[int] = []  # for each call of `one_thread_each` that has not ended, torch's threads before the first
_callers_lock = threading.Lock()

OnStep = Callable[[int, int, Tensor], None]
"""Callback: (number of the denoiser call, timestep, estimate of the clean latent) -> None."""

# Scheduler options that training fixes for all later samplers.
FORWARD_PROCESS = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "trained_betas",
    "prediction_type",
    "rescale_betas_zero_snr",
)


class Sampler:
    """Reverse diffusion with one of diffusers' deterministic schedulers.

    Args:
        scheduler: e.g. `diffusers.DDIMScheduler`; its options also define the forward process in training.
        steps: denoising steps unless a call overrides them (50 in the paper).
    """

    def __init__(self, scheduler: Any, steps: Annotated[int, Range(1, 10_000)] = 50) -> None:
        self.scheduler = scheduler
        self.steps = steps

    @torch.no_grad()
    def __call__(
        self,
        denoise: Denoise,
        noise: Latents,
        conditioning: Conditioning,
        guidance_weight: float = 0.0,
        steps: int | None = None,
        on_step: OnStep | None = None,
    ) -> Latents:
        """Denoise pure noise to latents (paper, Section 3.4). `noise` is the only source of randomness.

        A step costs one denoiser call (of twice the batch if the guidance weight lies between 0 and 1). Single-step
        schedulers of second order, such as Heun's, need two. `on_step` is called after each call.

        Raises:
            CompleteSplatError: the guidance weight lies outside of [0, 1], or the scheduler cannot make these steps.
        """
        scheduler = self.set_up(steps, noise.device)
        flow = is_flow(scheduler)
        latent: Tensor = noise if flow else noise * scheduler.init_noise_sigma
        for index, timestep in enumerate(scheduler.timesteps):
            level = timestep.round().long()
            inputs = latent if flow else scheduler.scale_model_input(latent, timestep)
            predicted = guided_noise(denoise, inputs, level.expand(len(noise)), conditioning, guidance_weight)
            if on_step is not None:
                on_step(index, int(level), clean_estimate(scheduler, inputs, predicted, level))
            latent = scheduler.step(predicted, timestep, latent).prev_sample
        return latent

    def set_up(self, steps: int | None = None, device: torch.device | None = None) -> Any:
        """Return a copy of the scheduler, set up for a number of steps (by default the sampler's).

        Schedulers keep state while they sample. Each call gets a copy, so that several threads can share a model.

        Raises:
            CompleteSplatError: the scheduler cannot make this number of steps.
        """
        scheduler = copy.deepcopy(self.scheduler)
        most = self.training_timesteps
        steps = self.steps if steps is None else steps
        if not 1 <= steps <= most:
            raise CompleteSplatError(f"steps={steps}: must lie between 1 and {most}")
        if isinstance(scheduler, DDIMScheduler) and most % steps:
            # DDIM goes down by whole timesteps, so a step would end at another noise level than the next one starts at.
            advice = f"must divide {most} (10, 20, 25, 40, 50, ...); sampler=dpm20 takes any number"
            raise CompleteSplatError(f"steps={steps}: DDIM's {advice}")
        # diffusers' own spacing for flow matching would end at t = 1/1000 and waste a step from there
        spacing = {"sigmas": np.linspace(1, 1 / steps, steps)} if is_flow(scheduler) else {"num_inference_steps": steps}
        scheduler.set_timesteps(**spacing, device=device)
        return scheduler

    def draw_timesteps(self, count: int, device: torch.device) -> Int[Tensor, " count"]:
        """Draw timesteps for training: uniform for diffusion, the logistic of a standard normal for flow matching."""
        if is_flow(self.scheduler):
            # This favours the middle (Esser et al. 2024, "Scaling Rectified Flow Transformers", Section 3.1).
            return (torch.randn(count, device=device).sigmoid() * self.training_timesteps).ceil().long()
        return torch.randint(self.training_timesteps, (count,), device=device)

    def add_noise(self, latent: Latents, noise: Tensor, timestep: Tensor) -> Latents:
        """Apply the forward process h_t = a h + b eps of the paper's Eq. 2 (`objective.signal_and_noise`)."""
        signal, share = signal_and_noise(self.scheduler, timestep, latent)
        return signal * latent + share * noise

    @property
    def training_timesteps(self) -> int:
        """Return T, the number of noise levels of the forward process."""
        return self.scheduler.config.num_train_timesteps


def with_forward_process(sampler: Mapping[str, Any], trained: Mapping[str, Any]) -> dict[str, Any]:
    """Return a sampler's config with the noise schedule and prediction type of the sampler used in training.

    Raises:
        CompleteSplatError: one of the two is for diffusion, the other for flow matching.
    """
    name = _scheduler_name(sampler)
    trained_name = _scheduler_name(trained)
    if name.startswith("FlowMatch") != trained_name.startswith("FlowMatch"):
        raise CompleteSplatError(f"sampler: {name} cannot draw from a denoiser that was trained for {trained_name}")
    fixed = {key: value for key, value in trained["scheduler"].items() if key in FORWARD_PROCESS}
    return {**sampler, "scheduler": {**sampler["scheduler"], **fixed}}


def _scheduler_name(sampler: Mapping[str, Any]) -> str:
    return str(sampler["scheduler"].get("_target_")).rpartition(".")[2]


def draw_noise(
    images: int, samples: int, shape: tuple[int, ...], seed: int | Sequence[int]
) -> Float[Tensor, "latent _ _ _"]:
    """Draw noise of this shape for several samples of each image, those of one image next to each other.

    Raises:
        CompleteSplatError: `seed` is neither one seed for all noise nor one seed for each image.
    """
    if isinstance(seed, Iterable):
        seeds = list(seed)
        if len(seeds) != images:
            raise CompleteSplatError(f"seed={seeds}: {len(seeds)} seeds for {images} images; give one for each image")
        return torch.cat([_noise((samples, *shape), image_seed) for image_seed in seeds])
    return _noise((images * samples, *shape), seed)


def _noise(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(int(seed)))


@contextmanager
def one_thread_each(denoiser: nn.Module, device: torch.device) -> Iterator[int]:
    """On a CPU, limit each operation of a small denoiser to one thread.

    It yields the number of threads that torch had before, or 0 if nothing is limited.

    A sample has hundreds of operations of a tenth of a millisecond. Threads that share one wait for each other after
    each, and longer beside another busy process. Threads that draw different samples do not. Neither parts (`part_of`)
    nor samples depend on the number of threads. Calls may overlap.
    """
    if device.type != "cpu" or sum(parameter.numel() for parameter in denoiser.parameters()) > SMALL:
        yield 0
        return
    with _callers_lock:
        before = _callers[0] if _callers else torch.get_num_threads()
        _callers.append(before)
    torch.set_num_threads(1)
    try:
        yield before
    finally:
        torch.set_num_threads(before)
        with _callers_lock:
            _callers.pop()


def part_of(count: int) -> int:
    """Return how many of `count` samples a thread draws at a time: half of them, as large parts take less time each."""
    return min(max(count // 2, PART), LARGEST_PART)


def in_parts(draw: Callable[[slice], T], count: int, most: int | None = None, threads: int = 0) -> list[T]:
    """Call `draw` for all of `count` samples in order, at most `most` at a time (None: all at once).

    If a GPU's memory does not suffice, log a warning and draw with parts of half the size.

    Args:
        threads: number of parts that are drawn at the same time, each by one thread.

    Raises:
        torch.cuda.OutOfMemoryError: a single sample does not fit.
    """
    parts: list[T] = []
    start = 0
    size = min(count if most is None else most, count)
    if threads > 1 and size < count:
        with ThreadPoolExecutor(threads) as pool:
            slices = [slice(first, min(first + size, count)) for first in range(0, count, size)]
            return list(pool.map(_with_modes_of_this_thread(draw), slices))
    while start < count:
        try:
            parts.append(draw(slice(start, min(start + size, count))))
            start += size
            continue
        except torch.cuda.OutOfMemoryError:
            if size == 1:
                raise
        # This is outside of the handler, where the error would still hold the computed tensors.
        torch.cuda.empty_cache()
        logger.warning("%d samples do not fit into the GPU's memory; going on with %d at a time", size, (size + 1) // 2)
        size = (size + 1) // 2
    return parts


def _with_modes_of_this_thread(draw: Callable[[slice], T]) -> Callable[[slice], T]:
    """Return a function that another thread can call: torch keeps gradients, inference and autocast for each thread."""
    grad = torch.is_grad_enabled()
    inference = torch.is_inference_mode_enabled()
    cast = torch.get_autocast_dtype("cpu"), torch.is_autocast_enabled("cpu")

    def in_modes(part: slice) -> T:
        torch.set_num_threads(1)
        with torch.autocast("cpu", *cast), torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return draw(part)

    return in_modes
