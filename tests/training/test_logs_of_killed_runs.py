"""A run that is killed at any moment and continued leaves the rows and figures of one that was not."""

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pandas
import pytest
import torch
from reliability import comparable
from small_runs import STEPS, fit, rows
from support import SMALL, script

from completesplat.training.loggers import MetricsFile


class Killed(BaseException): ...


def test_a_run_killed_before_every_change_of_a_file_leaves_all_rows(tmp_path, monkeypatch):
    fit(tmp_path / "whole")
    expected = rows(tmp_path / "whole")
    assert [row["val/loss"] != "" for row in expected].count(True) == 6  # five validations and the final row
    places = ((torch, "save"), (os, "link"), (os, "replace"), (MetricsFile, "save"))
    for survived in itertools.count(1, 3):
        changes = itertools.count()

        def counted(change, *arguments, changes=changes, survived=survived):
            if next(changes) >= survived:
                raise Killed  # and nothing tidies up behind a killed process
            return change(*arguments)

        folder = tmp_path / str(survived)
        with monkeypatch.context() as patch:
            for place, name in places:
                whole = getattr(place, name)
                made = partial(counted, whole) if place is not MetricsFile else None
                patch.setattr(place, name, made or (lambda self, whole=whole, counted=counted: counted(whole, self)))
            try:
                fit(folder)
            except Killed:
                pass
            else:
                break
        fit(folder)
        assert rows(folder) == expected, survived
    assert survived > 3 * STEPS


@pytest.mark.parametrize("steps", [6, 7, 12])
def test_a_run_that_ended_and_is_made_longer_is_one_that_was_as_long(tmp_path, steps):
    fit(tmp_path / "long")
    fit(tmp_path / "short", steps)
    fit(tmp_path / "short")
    assert rows(tmp_path / "short") == rows(tmp_path / "long")


def start(folder: Path, root: Path, out: Path) -> subprocess.Popen:
    given = ["fit", "experiment=toy_var", f"data.root={root}", *SMALL, "trainer.max_steps=40", f"out={out}"]
    given += ["callbacks.checkpoint.every_n_train_steps=2", "callbacks.pictures.every_n_steps=4", "ckpt_path=last"]
    given += ["trainer.val_check_interval=4", "trainer.log_every_n_steps=2", "data.references_per_sequence=4"]
    program = [sys.executable, script(folder), *given]
    return subprocess.Popen(program, start_new_session=True, stdout=subprocess.DEVNULL)


@pytest.mark.slow
def test_real_processes_that_are_killed_at_random_leave_all_rows_and_figures(toy_root, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    begun = time.monotonic()
    assert start(tmp_path, toy_root, whole).wait() == 0
    duration, chance = time.monotonic() - begun, random.Random(0)
    for _ in range(6):
        process = start(tmp_path, toy_root, killed)
        try:
            process.wait(timeout=chance.uniform(0.3, 0.9) * duration)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    assert start(tmp_path, toy_root, killed).wait() == 0
    (expected, figures), (table, found) = comparable(whole), comparable(killed)
    pandas.testing.assert_frame_equal(expected, table, check_exact=True)
    assert figures == found
