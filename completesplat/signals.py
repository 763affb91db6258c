"""Orderly end of the program after a signal, with exit status 128 + the signal's number.

The first signal raises `Interrupted` where the program stands, or waits until the program asks for it (training does
so at the end of a step). After that signals have their default effect: a second one ends the process at once.
"""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import active_children, parent_process
from multiprocessing.util import Finalize

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1)
"""Signals from `kill`, systems and clusters, Ctrl-C, a terminal that closes, and SLURM before a job's time is up."""

_received: int | None = None
_kept = False
_handled: list[signal.Signals] = []
"""Signals that `ended_by_signals` handles now."""


class Interrupted(SystemExit):
    """Exit of the program because of a signal."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.signal = signal.Signals(number)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """End the block with `Interrupted` after a signal, even if code inside the block swallowed the exception.

    Signals that are ignored (`nohup`), or for which another program has a handler, stay as they are.
    """
    global _received, _kept
    plain = (signal.SIG_DFL, signal.default_int_handler)
    ours = [number for number in ENDING if signal.getsignal(number) in plain]
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _first) for number in ours}
    _handled.extend(ours)
    try:
        yield
        if _received is not None:
            raise Interrupted(_received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _handled.clear()
        _received = None
        _kept = False


def restore_handlers() -> None:
    """Put the handlers of `ended_by_signals` back where another library has set its own."""
    if _received is None:
        for number in _handled:
            signal.signal(number, _first)


def received() -> int | None:
    """Return the number of the signal that came, None if none did."""
    return _received


def keep_signals(kept: bool) -> None:
    """Make signals wait for code that calls `received`, or, with `kept=False`, raise Interrupted at once again."""
    global _kept
    _kept = kept


def are_kept() -> bool:
    return _kept


def end(number: int) -> None:
    """Raise Interrupted as after this signal, which another process may have received."""
    global _received
    _received = number
    raise Interrupted(number)


def _first(number: int, frame: object) -> None:
    global _received
    _received = number
    for ending_signal in ENDING:
        if signal.getsignal(ending_signal) is _first:
            signal.signal(ending_signal, signal.SIG_DFL)
    if not _kept:
        raise Interrupted(number)


def _end_workers() -> None:
    for process in active_children():
        if process.daemon:
            process.kill()


# This runs when Python ends, before it waits for its workers, because they ignore its SIGTERM (`leave_to_parent`).
Finalize(None, _end_workers, exitpriority=0)


def leave_to_parent(_: int = 0) -> None:
    """Ignore signals in a worker process, because the parent process receives them, too, and ends its workers."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def end_with_parent() -> None:
    """Make a worker process raise Interrupted on its parent's SIGTERM, and end when the parent has ended."""
    leave_to_parent()
    signal.signal(signal.SIGTERM, _raise)
    parent = parent_process()
    assert parent is not None
    assert parent.pid is not None
    end_with(parent.pid)


def end_with(starter: int) -> None:
    """End this process when the process that started it has ended, for whatever reason."""

    def outlive() -> None:
        while os.getppid() == starter:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=outlive, daemon=True).start()


def _raise(number: int, frame: object) -> None:
    raise Interrupted(number)
