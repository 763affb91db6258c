"""The machine that figures were taken on."""

import datetime
import json
from pathlib import Path

import torch
from support import strict_json

from completesplat.results.machine import machine


def test_the_machine_can_be_written_as_json(tmp_path: Path) -> None:
    (tmp_path / "machine.json").write_text(json.dumps(machine()))
    found = strict_json(tmp_path / "machine.json")
    assert found == machine()
    assert found["processor"]
    assert found["threads"] == torch.get_num_threads()
    assert found["torch"] == torch.__version__
    assert datetime.date.fromisoformat(found["date"]) <= datetime.date.today()
