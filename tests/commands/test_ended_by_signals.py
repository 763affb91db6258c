"""Commands that a signal ends: they print how to continue, leave a checkpoint, and no unfinished files."""

import os
import shlex
import signal
import subprocess
import sys

import pytest
from support import SMALL, strict_json

from completesplat.training import encoding
from completesplat.training.checkpoints import read_checkpoint
from completesplat.training.reconstruction import ReconstructionModule

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("plain_signals")]


@pytest.fixture
def signalled(monkeypatch):
    """Make a method send a signal to its process, the first time that a condition holds."""

    def patch(place, name, number, condition=lambda self: True):
        original, sent = getattr(place, name), []

        def method(self, *inputs, **options):
            if not sent and condition(self):
                sent.append(number)
                os.kill(os.getpid(), number)
            return original(self, *inputs, **options)

        monkeypatch.setattr(place, name, method)

    return patch


def message(finished, number):
    """The checkpoint that the last line names, if any, and the arguments of the command that it says."""
    line = finished.err.splitlines()[-1]
    before, command = line.split(" with: ")
    assert before.startswith(f"ended by {signal.Signals(number).name}; ")
    name, *arguments = shlex.split(command)
    assert name == "completesplat"
    return before.partition("the checkpoint is ")[2].partition("; go on")[0], arguments


FIT = ["experiment=toy_var", *SMALL, "callbacks.images=null", "test=false", "trainer.max_steps=5"]


def test_fit_goes_on_with_the_command_that_it_says(command, toy_root, tmp_path, signalled):
    signalled(ReconstructionModule, "training_step", signal.SIGINT, lambda self: self.global_step == 2)
    finished = command("fit", *FIT, f"data.root={toy_root}", f"out={tmp_path / 'run'}")
    assert finished.status == 130, finished.err
    checkpoint, again = message(finished, signal.SIGINT)
    assert checkpoint == f"{tmp_path}/run/checkpoints/last.ckpt"
    assert read_checkpoint(checkpoint)["global_step"] == 3
    assert not (tmp_path / "run/metrics.json").exists()
    command.succeeds(*again)
    assert strict_json(tmp_path / "run/metrics.json")["steps"] == 5


def test_a_sweep_ends_with_the_job_that_gets_the_signal(command, toy_root, tmp_path, signalled):
    signalled(ReconstructionModule, "training_step", signal.SIGHUP, lambda self: self.global_step == 2)
    given = ["-m", *FIT, f"data.root={toy_root}", "seed=1,2"]
    finished = command("fit", *given, f"out={tmp_path / 'sweep'}")
    assert finished.status == 129
    checkpoint, again = message(finished, signal.SIGHUP)
    assert checkpoint == f"{tmp_path}/sweep/seed-1/checkpoints/last.ckpt"
    assert again == ["fit", *given, f"out={tmp_path / 'sweep'}"]
    assert not (tmp_path / "sweep/seed-2").exists()


def test_test_does_not_end_as_if_all_was_well(command, pipeline, tmp_path, signalled):
    signalled(ReconstructionModule, "test_step", signal.SIGTERM)
    given = [f"ckpt={pipeline.var}/checkpoints/last.ckpt", "trust=true", "trainer.accelerator=cpu"]
    finished = command("test", *given, f"out={tmp_path / 'test'}")
    assert finished.status == 143, finished.err
    assert message(finished, signal.SIGTERM) == ("", ["test", *given, f"out={tmp_path / 'test'}"])
    assert not (tmp_path / "test/metrics.json").exists()


def test_latents_leave_no_half_store(command, pipeline, packed_toys, tmp_path, signalled):
    signalled(encoding, "moment_sums", signal.SIGTERM)
    given = ["data_task=latents", f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", "trust=true"]
    given += [f"overrides=['data.root={packed_toys}']", f"out={tmp_path / 'latents'}"]
    finished = command("data", *given)
    assert finished.status == 143, finished.err
    assert not list((tmp_path / "latents").glob("*.arrow*"))
    command.succeeds(*message(finished, signal.SIGTERM)[1])


STARTED = """
import sys, time
from completesplat.signals import end_with
end_with(int(sys.argv[1]))
time.sleep(90)
print("alive")
"""
STARTER = """
import os, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", sys.argv[1], str(os.getpid())])
print("started", flush=True)
time.sleep(90)
"""


def test_a_process_of_a_job_does_not_outlive_the_one_that_started_it():
    """Also where that ends before this one has begun to look."""
    starter = subprocess.Popen([sys.executable, "-c", STARTER, STARTED], stdout=subprocess.PIPE, text=True)
    assert starter.stdout.readline() == "started\n"
    starter.kill()
    assert starter.wait() == -signal.SIGKILL
    assert starter.stdout.read() == ""  # ends when the other process has ended


def test_lightning_starts_processes_that_know_which_one_started_them(command, toy_root, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr("completesplat.commands.fit.run", lambda config, out: given.extend(sys.argv))
    command.succeeds("fit", *FIT, f"data.root={toy_root}", f"out={tmp_path / 'run'}")
    assert given[2] == f"--process-of={os.getpid()}:{tmp_path / 'run'}"
    ended, started = [], []
    monkeypatch.setattr("completesplat.commands.end_with", ended.append)
    monkeypatch.setattr("completesplat.commands.fit.run", lambda config, out: started.append(out))
    command.succeeds("fit", given[2])
    assert (ended, started) == ([os.getpid()], [tmp_path / "run"])


def test_a_signal_while_a_run_s_own_files_are_written_leaves_no_half_one(command, toy_root, tmp_path, monkeypatch):
    monkeypatch.setattr("completesplat.commands.continuing._record", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    finished = command("fit", *FIT, f"data.root={toy_root}", f"out={tmp_path / 'run'}")
    assert finished.status == 143
    assert message(finished, signal.SIGTERM)[0] == ""
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {"config.yaml", ".lock", "commands.log", "fit.log"}
