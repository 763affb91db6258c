"""End of training after a signal: all processes stop together, and SLURM requeues the job if it is set up to."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from socket import socketpair
from typing import Any

import lightning
import torch
from lightning import Trainer
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.strategies.launchers import subprocess_script as launcher_of_fabric
from lightning.pytorch.strategies.launchers import subprocess_script as launcher_of_trainers

from completesplat import signals
from completesplat.signals import Interrupted

LOOK_SECONDS = 0.5
GRACE_SECONDS = 5.0
"""Interval at which a process checks its child processes, and their time to end by themselves."""
LAUNCHERS: tuple[Any, ...] = (launcher_of_fabric, launcher_of_trainers)

logger = logging.getLogger(__name__)


@contextmanager
def stopped_together() -> Iterator[None]:
    """Let processes that trainers or `Fabric` start end with this one."""
    started: list[subprocess.Popen[bytes]] = []
    observers: list[_Observer] = []

    def observe(processes: list[subprocess.Popen[bytes]]) -> None:
        if processes:
            started.extend(processes)
            observers.append(_Observer(processes))
            observers[-1].start()

    try:
        with _observed_by(observe):
            yield
    except (Interrupted, RuntimeError) as error:
        number = error.signal if isinstance(error, Interrupted) else signals.received()
        if number is None:
            raise
        for process in started:
            _end(process, number)
        raise Interrupted(number) from error  # this process may have waited for others that ended earlier
    finally:
        # Their sockets stay open until here, because Python would write into a file that reuses a closed one's number.
        if observers:
            signal.set_wakeup_fd(-1)


@contextmanager
def _observed_by(observe: Callable[[list[subprocess.Popen[bytes]]], None]) -> Iterator[None]:
    """Replace Lightning's observer of child processes by `observe`.

    Lightning's own, which is private, kills this process within five seconds after a signal has ended another one, so
    that nothing could say how to continue. This can go when Lightning lets a launcher choose its observer, or ends all
    processes by the signal that one of them got. Where a release has renamed it, Lightning keeps its own behaviour.
    """
    before = [getattr(launcher, "_launch_process_observer", None) for launcher in LAUNCHERS]
    if None in before:
        message = "lightning %s has other names: processes that a signal ends are handled in its own way"
        logger.warning(message, lightning.__version__)
        yield
        return
    for launcher in LAUNCHERS:
        launcher._launch_process_observer = observe
    try:
        yield
    finally:
        for launcher, function in zip(LAUNCHERS, before, strict=True):
            launcher._launch_process_observer = function


def _end(process: "subprocess.Popen[bytes]", number: int) -> None:
    """Wait for a process to end.

    Send it the signal after a second, and kill it after five more.
    """
    for seconds, next_number in ((GRACE_SECONDS / 5, number), (GRACE_SECONDS, signal.SIGKILL)):
        try:
            process.wait(seconds)
            return
        except subprocess.TimeoutExpired:
            process.send_signal(next_number)
    process.wait()


class _Observer(threading.Thread):
    """Observer of child processes: if a signal ended one of them, this process gets it; another failure kills all.

    While this process waits for another one, Python's handlers do not run. Outside of training the signal then still
    ends it after `GRACE_SECONDS`.
    """

    def __init__(self, processes: list[subprocess.Popen[bytes]]) -> None:
        super().__init__(name="child-process-observer", daemon=True)
        self._processes = processes
        self._signals, self._written = socketpair()
        self._signals.setblocking(False)
        self._written.setblocking(False)
        signal.set_wakeup_fd(self._written.fileno(), warn_on_full_buffer=False)

    def run(self) -> None:
        while signals.received() is None:
            codes = [process.poll() for process in self._processes]
            theirs = {code - 128 if code > 0 else -code for code in codes if code} & set(signals.ENDING)
            local = set() if signals.are_kept() else self._received_here() & set(signals.ENDING)
            if theirs | local:
                return self._pass_on(min(theirs | local), to_this_process=not local)
            if any(codes):
                self._kill_children()  # SIGTERM would not end processes that wait for each other
                os.kill(os.getpid(), signal.SIGKILL)
            if all(code == 0 for code in codes):
                return
            time.sleep(LOOK_SECONDS)

    def _pass_on(self, number: int, to_this_process: bool) -> None:
        if to_this_process:
            os.kill(os.getpid(), number)
        time.sleep(GRACE_SECONDS)
        if signals.received() is None:
            self._kill_children()
            print(f"ended by {signal.Signals(number).name}", file=sys.stderr, flush=True)
            os._exit(128 + number)

    def _kill_children(self) -> None:
        for process in self._processes:
            process.kill()

    def _received_here(self) -> set[int]:
        try:
            return set(self._signals.recv(64))
        except BlockingIOError:
            return set()


def agreed_signal(trainer: Trainer) -> int | None:
    """Return the signal that a process of the run received, if any did.

    All processes have to call this.
    """
    if trainer.world_size == 1:
        return signals.received()  # without a wait for the GPU
    local = torch.tensor(signals.received() or 0, device=trainer.strategy.root_device)
    return int(trainer.strategy.reduce(local, reduce_op="max")) or None


def end_training(trainer: Trainer, number: int) -> None:
    """Raise Interrupted in all processes, after requeueing the job if this signal asks for it."""
    if trainer.is_global_zero:
        _requeue(trainer, number)
    trainer.strategy.barrier("end_training")
    signals.end(number)


def _requeue(trainer: Trainer, number: int) -> None:
    # Trainers of one device have no environment; Lightning then takes SLURM's as well.
    detected = SLURMEnvironment() if SLURMEnvironment.detect() else None
    environment = getattr(trainer.strategy, "cluster_environment", detected)
    if not isinstance(environment, SLURMEnvironment) or not environment.auto_requeue:
        return
    if number != environment.requeue_signal:
        return
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # SLURM sends it to a job that it requeues
    job = os.environ["SLURM_JOB_ID"]
    if "SLURM_ARRAY_JOB_ID" in os.environ:
        job = f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    try:
        subprocess.run(["scontrol", "requeue", job], check=True)
        logger.info("SLURM queues job %s again", job)
    except (OSError, subprocess.CalledProcessError) as error:
        logger.warning("SLURM did not queue job %s again: %s", job, error)
