"""How training ends after a signal: all processes together, and queued again where SLURM asks for it."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from socket import socketpair
from typing import Any, cast

import torch
from lightning import Trainer
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.strategies.launchers import subprocess_script as launcher_of_fabric
from lightning.fabric.strategies.launchers.subprocess_script import _ChildProcessObserver
from lightning.pytorch.strategies.launchers import subprocess_script as launcher_of_trainers
from lightning.pytorch.trainer.connectors.signal_connector import _SignalConnector

from completesplat import signals
from completesplat.signals import Interrupted

LOOK_SECONDS, GRACE_SECONDS = 0.5, 5.0
"""How often a process looks after those that it started, and how long one has to end by itself."""

logger = logging.getLogger(__name__)


@contextmanager
def stopped_together() -> Iterator[None]:
    """Trainers inside leave signals to `completesplat.signals`, and the processes that they start end with this one.

    So do those of Lightning's `Fabric`.

    Lightning's own handlers wait for other processes in the middle of a step, for ever if these are not there; they end
    `fit` and `test` with exit status 0, and its observer kills the first process when another one has got a signal.
    """
    started: list[subprocess.Popen[bytes]] = []
    observers: list[_Observer] = []

    def observe(processes: list[subprocess.Popen[bytes]]) -> None:
        if processes:
            started.extend(processes)
            observers.append(_Observer(os.getpid(), processes))
            observers[-1].start()

    connector, launchers = cast(Any, _SignalConnector), (launcher_of_fabric, launcher_of_trainers)
    before = connector.register_signal_handlers, launchers[0]._launch_process_observer
    connector.register_signal_handlers = lambda self: None
    for launcher in launchers:
        launcher._launch_process_observer = observe  # type: ignore[attr-defined]
    try:
        yield
    except (Interrupted, RuntimeError) as error:
        number = error.signal if isinstance(error, Interrupted) else signals.received()
        if number is None:
            raise
        for process in started:
            _end(process, number)
        raise Interrupted(number) from error  # other processes may have gone before, for which this one waited
    finally:
        connector.register_signal_handlers = before[0]
        for launcher in launchers:
            launcher._launch_process_observer = before[1]  # type: ignore[attr-defined]
        # Their sockets are open until here: what is opened with the number of a closed one would be written to.
        if observers:
            signal.set_wakeup_fd(-1)


def _end(process: "subprocess.Popen[bytes]", number: int) -> None:
    for seconds, next_number in ((GRACE_SECONDS / 5, number), (GRACE_SECONDS, signal.SIGKILL), (None, None)):
        try:
            process.wait(seconds)
            return
        except subprocess.TimeoutExpired:
            assert next_number is not None
            process.send_signal(next_number)


class _Observer(_ChildProcessObserver):
    """A process that was ended by a signal ends this one as if it had got it; after other failures, as Lightning's.

    While this process waits for another one, Python's handlers do not run. Outside of training the signal ends it then
    after `GRACE_SECONDS` all the same.
    """

    def __init__(self, main_pid: int, processes: list[subprocess.Popen[bytes]]) -> None:
        super().__init__(main_pid, processes, LOOK_SECONDS)  # type: ignore[arg-type]
        self._signals, self._written = socketpair()
        self._signals.setblocking(False)
        self._written.setblocking(False)
        signal.set_wakeup_fd(self._written.fileno(), warn_on_full_buffer=False)

    def _run(self) -> bool:
        codes = [process.poll() for process in self._child_processes]
        theirs = {code - 128 if code > 0 else -code for code in codes if code} & set(signals.ENDING)
        own = set() if signals.are_kept() else self._own() & set(signals.ENDING)
        if signals.received() is not None:
            return True
        if not theirs | own:
            return super()._run()
        number = min(theirs | own)
        if not own:
            os.kill(self._main_pid, number)
        time.sleep(GRACE_SECONDS)
        if signals.received() is None:
            for process in self._child_processes:
                process.kill()
            print(f"ended by {signal.Signals(number).name}", file=sys.stderr, flush=True)
            os._exit(128 + number)
        return True

    def _own(self) -> set[int]:
        try:
            return set(self._signals.recv(64))
        except BlockingIOError:
            return set()


def agreed(trainer: Trainer) -> int | None:
    """The signal that a process of the run has got, if any has. All processes have to ask."""
    own = torch.tensor(signals.received() or 0, device=trainer.strategy.root_device)
    return int(trainer.strategy.reduce(own, reduce_op="max")) or None


def end_training(trainer: Trainer, number: int) -> None:
    """`Interrupted` in all processes, after the job was queued again where this signal asks for that."""
    if trainer.is_global_zero:
        _requeue(trainer, number)
    trainer.strategy.barrier("end_training")
    signals.end(number)


def _requeue(trainer: Any, number: int) -> None:
    environment = trainer._accelerator_connector.cluster_environment
    if not isinstance(environment, SLURMEnvironment) or not environment.auto_requeue:
        return
    if number != environment.requeue_signal:
        return
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # with which SLURM ends what it queues again
    job = os.environ["SLURM_JOB_ID"]
    if "SLURM_ARRAY_JOB_ID" in os.environ:
        job = f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    try:
        subprocess.run(["scontrol", "requeue", job], check=True)
        logger.info("SLURM queues job %s again", job)
    except (OSError, subprocess.CalledProcessError) as error:
        logger.warning("SLURM did not queue job %s again: %s", job, error)
