"""Signals that ask a program to end: it ends in good order, with exit status 128 + the signal's number.

The first signal raises `Interrupted` where the program stands, or is kept until work says that it can end there
(training: at the end of a step). From then on signals have the system's effect: a second one ends the process at once.
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
"""Sent by `kill`, systems and clusters, Ctrl-C, a terminal that closes, and SLURM before a job's time is up."""

_received: int | None = None
_kept = False


class Interrupted(SystemExit):
    """The end of the program because of a signal."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.signal = signal.Signals(number)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """What is done inside ends with `Interrupted` after a signal, also where that was swallowed on its way.

    Signals that are ignored (`nohup`) or that another program has a handler for stay as they are.
    """
    global _received, _kept
    plain = (signal.SIG_DFL, signal.default_int_handler)
    ours = [number for number in ENDING if signal.getsignal(number) in plain]
    if threading.current_thread() is not threading.main_thread():
        ours = []
    before = {number: signal.signal(number, _first) for number in ours}
    try:
        yield
        if ours and _received is not None:
            raise Interrupted(_received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if ours:
            _received, _kept = None, False


def received() -> int | None:
    """The signal that came, if any did."""
    return _received


def keep_signals(kept: bool) -> None:
    """From now on a signal waits for whoever asks by `received`; or, with `kept=False`, it raises again."""
    global _kept
    _kept = kept


def are_kept() -> bool:
    """Whether signals wait."""
    return _kept


def end(number: int) -> None:
    """`Interrupted`, as after this signal, which another process may have got."""
    global _received
    _received = number
    raise Interrupted(number)


def _first(number: int, frame: object) -> None:
    global _received
    _received = number
    for one in ENDING:
        if signal.getsignal(one) is _first:
            signal.signal(one, signal.SIG_DFL)
    if not _kept:
        raise Interrupted(number)


def _end_workers() -> None:
    for process in active_children():
        if process.daemon:
            process.kill()


# When Python ends, before it waits for them: they ignore the signal by which it would end them (`leave_to_parent`).
Finalize(None, _end_workers, exitpriority=0)


def leave_to_parent(_: int = 0) -> None:
    """In a worker process: signals to all processes of the program are its parent's, which ends its workers."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def end_with_parent() -> None:
    """In a worker process: what it does ends with `Interrupted` if the parent ends it, and it does not outlive that."""
    leave_to_parent()
    signal.signal(signal.SIGTERM, _raise)
    threading.Thread(target=_outlive_nobody, daemon=True).start()


def end_with(starter: int) -> None:
    """In a process that another started: it does not outlive that, however that ends, wherever it stands itself."""
    threading.Thread(target=_outlive, args=(starter,), daemon=True).start()


def _outlive(starter: int) -> None:
    while os.getppid() == starter:
        time.sleep(1)
    os._exit(1)


def _raise(number: int, frame: object) -> None:
    raise Interrupted(number)


def _outlive_nobody() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
