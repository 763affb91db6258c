"""A signal ends training after the step that it came in; what goes on from there is as if there had been none."""

import gc
import os
import signal
import stat
import subprocess
import sys
import threading
from contextlib import suppress

import pytest
import torch
from lightning.fabric.strategies.launchers import subprocess_script as launcher
from small_runs import STEPS, Logging, fit, rows
from support import LIMIT, write_program

from completesplat import signals
from completesplat.signals import ENDING, Interrupted, ended_by_signals, received, restore_handlers
from completesplat.training.checkpoints import read_checkpoint
from completesplat.training.stopping import stopped_together

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("plain_signals")]
NEVER = 500  # steps between checkpoints


class Signalled(Logging):
    """Gets a signal in its eighth step, in the first of its batches."""

    number = signal.SIGINT

    def training_step(self, batch, index):
        if self.global_step == 7 and received() is None:
            os.kill(os.getpid(), self.number)
        return super().training_step(batch, index)


def interrupted(folder, number, **settings):
    model = type("Signalled", (Signalled,), {"number": number})
    before = [signal.getsignal(one) for one in ENDING]
    with pytest.raises(Interrupted) as stop, stopped_together(), ended_by_signals():
        fit(folder, every=NEVER, model=model, **settings)
    assert stop.value.code == 128 + number
    assert [signal.getsignal(one) for one in ENDING] == before


def saved(folder):
    return read_checkpoint(folder / "checkpoints/last.ckpt")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    fit(folder, every=NEVER)
    return folder


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_loses_nothing_of_the_steps_before_it(whole, tmp_path, number):
    interrupted(tmp_path, number)
    assert saved(tmp_path)["global_step"] == 8
    assert rows(tmp_path) == rows(whole)[: len(rows(tmp_path))]
    fit(tmp_path, every=NEVER)
    assert rows(tmp_path) == rows(whole)
    expected, result = saved(whole), saved(tmp_path)
    assert all(torch.equal(result["state_dict"][name], value) for name, value in expected["state_dict"].items())
    assert result["global_step"] == expected["global_step"] == STEPS


def test_a_signal_waits_for_the_end_of_a_step_of_several_batches(tmp_path):
    interrupted(tmp_path, signal.SIGTERM, accumulate_grad_batches=2)
    assert saved(tmp_path)["global_step"] == 8


def test_slurm_queues_a_job_again_after_its_own_signal_only(tmp_path, monkeypatch):
    """With the variables of `srun`, as Lightning's plugin reads them, and a `scontrol` that notes its arguments."""
    called = tmp_path / "called"
    write_program(tmp_path / "scontrol", f'echo "$@" >> {called}')
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    numbers = {"NTASKS": 1, "PROCID": 0, "LOCALID": 0, "NODEID": 0, "JOB_ID": 4711}
    for name, value in {**numbers, "JOB_NAME": "training"}.items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))

    interrupted(tmp_path / "ended", signal.SIGTERM)
    assert not called.exists()
    interrupted(tmp_path / "queued", signal.SIGUSR1)
    assert called.read_text() == "requeue 4711\n"
    assert saved(tmp_path / "queued")["global_step"] == 8

    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "4700")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "11")
    interrupted(tmp_path / "of_an_array", signal.SIGUSR1)
    assert called.read_text() == "requeue 4711\nrequeue 4700_11\n"
    fit(tmp_path / "of_an_array", every=NEVER)
    assert saved(tmp_path / "of_an_array")["global_step"] == STEPS


def process(*lines: str) -> subprocess.Popen:
    """A process that writes a line inside `ended_by_signals`, and another when it has received a signal."""
    program = ["import os, signal, time", "from completesplat.signals import *", *lines]
    program += ["with ended_by_signals():", "    print(flush=True)"]
    program += ["    while received() is None:", "        time.sleep(0.01)"]
    program += ["    print(flush=True)", f"    time.sleep({LIMIT})"]
    started = subprocess.Popen([sys.executable, "-c", "\n".join(program)], stdout=subprocess.PIPE)
    started.stdout.readline()
    return started


@pytest.mark.parametrize("number", ENDING)
def test_outside_of_training_the_first_signal_ends_at_once_in_training_the_second(number):
    with process() as one:
        one.send_signal(number)
        assert one.wait(LIMIT) == 128 + number
    with process("keep_signals(True)") as one:
        one.send_signal(number)
        assert one.stdout.readline() == b"\n"  # it has been received
        one.send_signal(signal.SIGTERM)
        assert one.wait(LIMIT) == -signal.SIGTERM


def test_a_signal_that_is_ignored_as_by_nohup_stays_ignored():
    """SIGHUP has the lower number, so it would be handled first if it were not ignored."""
    with process("signal.signal(signal.SIGHUP, signal.SIG_IGN)") as one:
        one.send_signal(signal.SIGHUP)
        one.send_signal(signal.SIGTERM)
        assert one.wait(LIMIT) == 128 + signal.SIGTERM


def test_a_signal_that_was_swallowed_does_not_end_with_success():
    with pytest.raises(Interrupted), ended_by_signals(), suppress(Interrupted):
        os.kill(os.getpid(), signal.SIGTERM)


def test_an_error_after_a_signal_ends_as_the_signal_does(monkeypatch):
    with pytest.raises(RuntimeError, match="reset"), stopped_together():
        raise RuntimeError("Connection reset by peer")
    monkeypatch.setattr(signals, "received", lambda: signal.SIGTERM)
    with pytest.raises(Interrupted) as stop, stopped_together():
        raise RuntimeError("Connection reset by peer")
    assert stop.value.signal == signal.SIGTERM


def test_a_program_ends_whose_workers_nobody_has_ended():
    """Python's own way would be SIGTERM, which they ignore, and then to wait for them."""
    lines = ["import multiprocessing, time", "from completesplat.signals import leave_to_parent"]
    lines += ["forked = multiprocessing.get_context('fork')", "ready = forked.Event()"]
    lines += ["def work():", "    leave_to_parent()", "    ready.set()", f"    time.sleep({2 * LIMIT})"]
    lines += ["forked.Process(target=work, daemon=True).start()", "ready.wait()"]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], timeout=LIMIT, check=True)


def test_a_lightning_with_other_names_keeps_its_own_behaviour_with_a_warning(monkeypatch, caplog):
    monkeypatch.delattr(launcher, "_launch_process_observer")
    with stopped_together():
        assert not hasattr(launcher, "_launch_process_observer")
    assert "its own way" in caplog.text


def test_handlers_of_another_library_are_replaced_until_a_signal_comes():
    others = []
    with suppress(Interrupted), ended_by_signals():
        signal.signal(signal.SIGTERM, lambda *_: others.append("another"))
        restore_handlers()
        os.kill(os.getpid(), signal.SIGTERM)
        others.append("goes on")
    assert others == []
    restore_handlers()  # outside, there are none
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize(
    ("ends", "status"), [("kill -TERM $$", 128 + signal.SIGTERM), ("exit 1", -signal.SIGKILL), ("exit 0", 0)]
)
def test_a_process_ends_as_one_that_it_started(ends, status):
    """While another child works on, it holds the pipe, so that reading it ends with the last process."""
    work, wait = (3, 5) if status == 0 else (LIMIT, LIMIT)
    lines = ["import subprocess, time", "from lightning.fabric.strategies.launchers import subprocess_script"]
    lines += ["from completesplat.signals import ended_by_signals"]
    lines += ["from completesplat.training.stopping import stopped_together"]
    lines += ["with stopped_together(), ended_by_signals():"]
    lines += [f"    commands = 'sleep 1; {ends}', 'exec sleep {work}'"]
    lines += ["    started = [subprocess.Popen(['sh', '-c', command]) for command in commands]"]
    lines += ["    subprocess_script._launch_process_observer(started)", f"    time.sleep({wait})"]
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], timeout=LIMIT / 3, stdout=subprocess.PIPE)
    assert done.returncode == status


def test_numbers_of_signals_are_written_to_a_socket_that_is_open_and_to_nothing_else():
    """A file that gets a closed socket's number, such as a checkpoint, would get a byte with each signal."""
    with stopped_together():
        launcher._launch_process_observer([])
        assert signal.set_wakeup_fd(-1) == -1
        with subprocess.Popen(["true"]) as child:
            launcher._launch_process_observer([child])
        for thread in threading.enumerate():
            if thread.name == "child-process-observer":
                thread.join()
        del thread
        gc.collect()
        written = signal.set_wakeup_fd(-1)
        signal.set_wakeup_fd(written)
        assert stat.S_ISSOCK(os.fstat(written).st_mode)
    assert signal.set_wakeup_fd(-1) == -1
