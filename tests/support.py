"""What tests of commands share."""

import json
import sys
from pathlib import Path

import pytest

from completesplat import cli

SMALL = [
    "trainer.max_steps=2",
    "trainer.accelerator=cpu",
    "trainer.val_check_interval=2",
    "trainer.limit_val_batches=1",
    "callbacks.progress=null",
    "data.image_size=32",
    "data.batch_size=2",
    "data.evaluation_targets=2",
]


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["completesplat", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    return 0


def strict_json(path: Path):
    """Parse JSON, refusing the NaN and Infinity that Python's reader lets through."""

    def refuse(name: str):
        raise ValueError(f"{path} holds {name}")

    return json.loads(path.read_text(), parse_constant=refuse)
