"""A run that is killed at any moment and continued leaves the rows and figures of one that was not."""

import csv
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
from lightning import Trainer
from lightning.pytorch.demos.boring_classes import BoringModel
from small_runs import Batches
from support import SMALL, script, strict_json

from completesplat.training.checkpoints import LAST, CheckpointFiles, Checkpoints
from completesplat.training.loggers import ContinuedCSVLogger, MetricsFile

STEPS = 15  # an epoch has twelve


class Killed(BaseException): ...


class Logging(BoringModel):
    """Rows of every second step, of validation at every third, and of some steps by itself."""

    def training_step(self, batch, index):
        loss = self.layer(batch).square().mean()
        self.log("train/loss", loss.detach())
        if self.global_step % 4 == 1:
            self.logger.log_metrics({"own": loss.item()}, step=self.global_step)
        return loss

    def validation_step(self, batch, index):
        self.log("val/loss", self.layer(batch).square().mean())


def fit(folder: Path, steps: int = STEPS) -> None:
    """Go on in a folder, as `completesplat fit ckpt_path=last` does, and write the final row."""
    torch.manual_seed(0)
    module, logger = Logging(), ContinuedCSVLogger(str(folder))
    checkpoints = Checkpoints(str(folder / "checkpoints"), every_n_train_steps=1, keep_every=5)
    trainer = Trainer(
        max_steps=steps, accelerator="cpu", logger=logger, plugins=[CheckpointFiles()], callbacks=[checkpoints],
        log_every_n_steps=2, val_check_interval=3, check_val_every_n_epoch=None, num_sanity_val_steps=0,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    last = folder / "checkpoints" / LAST
    validation = torch.utils.data.DataLoader(torch.ones(1, 32))
    trainer.fit(module, Batches(), validation, ckpt_path=last if last.is_file() else None, weights_only=True)
    figures = {name: value.item() for name, value in trainer.callback_metrics.items()}
    logger.log_metrics(figures, step=trainer.global_step)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


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


def comparable(out: Path) -> tuple[pandas.DataFrame, dict]:
    """Without times, speeds, and what names the run."""
    times = ("speed/", "memory/")
    table = pandas.read_csv(out / "metrics.csv")
    table = table[[column for column in table if not column.startswith(times) and "seconds" not in column]]
    found = {key: value for key, value in strict_json(out / "metrics.json").items() if not key.startswith(times)}
    for key in ("machine", "command", "checkpoint"):
        found["test"]["protocol"].pop(key)
    found["test"]["model"].pop("seconds")
    return table, found


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
