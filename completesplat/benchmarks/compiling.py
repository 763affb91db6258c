"""Compilation within a time limit, for comparisons with networks that are not compiled."""

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
    """Error of a comparison that cannot be measured on this machine, for the reason in the message."""


def compiled_within(limit: float, network: nn.Module, work: Callable[[Any], object], **settings: Any) -> Any:
    """Compile a network by `torch.compile` with these settings, call `work` once with it, and return it.

    Raises:
        NotMeasured: this takes more than `limit` seconds or fails, for example without a C++ compiler; or `limit` is 0.
    """
    if not limit:
        raise NotMeasured("compile_limit=0")
    try:
        with at_most(limit), warnings.catch_warnings(action="ignore"):  # about code that torch does not trace
            compiled = torch.compile(network, **settings)
            work(compiled)
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        raise NotMeasured(f"torch.compile failed: {type(error).__name__}: {first}") from error
    except _TimeIsUp:
        raise NotMeasured(f"torch.compile took longer than compile_limit={limit:g} s") from None
    return compiled


class _TimeIsUp(BaseException):
    """Interruption by `at_most`; no Exception, because the interrupted code may handle those."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Interrupt the context after this time, if the system and the thread allow it."""
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
