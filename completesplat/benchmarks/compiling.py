"""Compiling within a time, for comparisons with what is not compiled."""

import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

from completesplat.errors import CompleteSplatError


class NotMeasured(CompleteSplatError):
    """A comparison has no figures on this machine, for the reason in the message."""


def compiled_within(limit: float, network: nn.Module, work: Callable[[Any], object], **settings: Any) -> Any:
    """The network as `torch.compile` makes it with these settings, after the work was done once with it.

    Args:
        limit: seconds that this may take; 0: nothing is compiled.

    Raises:
        NotMeasured: it takes longer or fails, for want of a C++ compiler, say.
    """
    if not limit:
        raise NotMeasured("compile_limit=0")
    try:
        with at_most(limit), warnings.catch_warnings(action="ignore"):  # of code that torch will not see into
            compiled = torch.compile(network, **settings)
            work(compiled)
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        raise NotMeasured(f"torch.compile failed: {type(error).__name__}: {first}") from error
    except _TimeIsUp:
        raise NotMeasured(f"torch.compile took longer than compile_limit={limit:g} s") from None
    return compiled


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
