"""What `torch.compile` saves in the denoiser, once it has compiled it."""

import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from completesplat.generation import CompleteSplat
from completesplat.reports.diffusion.comparing import Comparison, NotMeasured
from completesplat.reports.diffusion.training import autocast


def compiled_vs_eager(model: CompleteSplat, batch: int, precision: str, limit: float) -> Comparison:
    """Forward and backward pass of the denoiser on noise, as in a training step; compiles it now.

    Args:
        limit: seconds that compiling may take; 0: nothing is compiled.

    Raises:
        NotMeasured: it takes longer or fails, for want of a C++ compiler, say.
    """
    if not limit:
        raise NotMeasured("compile_limit=0")
    denoiser, device = model.denoiser, model.latent_scale.device
    with torch.no_grad():
        conditioning = model.conditioning(torch.rand(batch, 3, model.image_size, model.image_size, device=device))
    latent = torch.randn(batch, denoiser.latent_channels, *conditioning.shape[-2:], device=device)
    timestep = torch.arange(batch, device=device)

    def work(network: Callable[..., Any]) -> None:
        with autocast(device, precision):
            loss = network(latent, timestep, conditioning).square().mean()
        loss.backward()
        denoiser.zero_grad()

    denoiser.train()
    try:
        with at_most(limit), warnings.catch_warnings(action="ignore"):  # of code that torch will not see into
            compiled = torch.compile(denoiser)
            work(compiled)
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        raise NotMeasured(f"torch.compile failed: {type(error).__name__}: {first}") from error
    except _TimeIsUp:
        raise NotMeasured(f"torch.compile took longer than compile_limit={limit:g} s") from None
    return Comparison(
        "compiled_vs_eager",
        ("denoiser compiled, both passes", lambda: work(compiled)),
        ("as it is", lambda: work(denoiser)),
    )


class _TimeIsUp(BaseException):
    """No Exception, because what is interrupted may handle those."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Interrupt what takes longer, where the system and the thread allow it."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise _TimeIsUp

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
