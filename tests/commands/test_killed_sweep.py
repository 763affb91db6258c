"""A sweep that is killed, twice, ends in the table that it would have had: minutes, so run by `make test-slow`."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support import SMALL, script, strict_json

pytestmark = pytest.mark.slow
JOBS = ["ablation-full+seed-0", "ablation-full+seed-1", "ablation-m1+seed-0", "ablation-m1+seed-1"]


def start(folder: Path, root: Path, out: Path) -> subprocess.Popen:
    arguments = ["fit", "-m", "experiment=toy_var", f"data.root={root}", *SMALL, "trainer.max_steps=60", f"out={out}"]
    arguments += ["callbacks.checkpoint.every_n_train_steps=3", "callbacks.pictures=null"]
    arguments += ["trainer.val_check_interval=60", "ablation=full,m1", "seed=0,1"]
    program = [sys.executable, script(folder), *arguments]
    return subprocess.Popen(program, start_new_session=True, stdout=subprocess.DEVNULL)


def kill_in_the_middle_of(job: Path, process: subprocess.Popen) -> None:
    while not (job / "checkpoints/last.ckpt").exists():
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (job / "metrics.json").exists()


def logged_steps(job: Path) -> list[int]:
    with open(job / "metrics.csv") as file:
        return [int(row["step"]) for row in csv.DictReader(file) if row["train/mse"]]


def test_a_sweep_that_is_killed_twice_ends_in_the_same_table(toy_root, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(tmp_path, toy_root, whole).wait() == 0

    kill_in_the_middle_of(killed / JOBS[1], start(tmp_path, toy_root, killed))
    first = (killed / JOBS[0] / "metrics.json").stat().st_mtime_ns
    assert "1 of 4" in (killed / "summary.md").read_text()
    kill_in_the_middle_of(killed / JOBS[2], start(tmp_path, toy_root, killed))
    assert start(tmp_path, toy_root, killed).wait() == 0

    assert sorted(path.name for path in killed.iterdir() if path.is_dir()) == JOBS
    assert (killed / JOBS[0] / "metrics.json").stat().st_mtime_ns == first
    assert (killed / "summary.csv").read_bytes() == (whole / "summary.csv").read_bytes()
    for job, times in zip(JOBS, (0, 1, 1, 0), strict=True):
        assert len(strict_json(killed / job / "run.json").get("continued", [])) == times
        assert logged_steps(killed / job) == logged_steps(whole / job) == sorted(logged_steps(whole / job))
