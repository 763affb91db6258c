"""`completesplat test` by two processes gives the figures of one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import LIMIT, script, strict_json


def scores(checkpoint: Path, out: Path, folder: Path, *settings: str) -> dict:
    command = [sys.executable, str(script(folder)), "test", f"ckpt={checkpoint}", f"out={out}", *settings]
    subprocess.run(command, check=True, timeout=LIMIT, cwd=folder, env=os.environ | {"OMP_NUM_THREADS": "1"})
    metrics = strict_json(out / "metrics.json")
    assert metrics["protocol"]["scenes"] == metrics["model"]["scenes"]
    del metrics["protocol"], metrics["model"]["seconds"]
    return metrics


@pytest.mark.slow
def test_two_processes_find_what_one_finds(pipeline, tmp_path):
    checkpoint = pipeline.diffusion / "checkpoints/last.ckpt"
    # Three test scenes: one process has two of them, the other one.
    changes = [
        f"data.root={tmp_path / 'more'}",
        "data.make=true",
        "data.scenes=30",
        "data.frames=3",
        "data.evaluation_batch_size=1",
    ]
    settings = ["trainer.accelerator=cpu", "overrides=[" + ",".join(f"'{change}'" for change in changes) + "]"]
    settings += ["sampler=dpm10", "evaluation.scoring.samples=2"]
    one = scores(checkpoint, tmp_path / "one", tmp_path, *settings)
    two = scores(checkpoint, tmp_path / "two", tmp_path, *settings, "trainer.devices=2", "trainer.strategy=ddp")
    assert one["model"]["scenes"] == 3
    assert two == one
