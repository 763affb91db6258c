"""Description of the machine."""

import json
from pathlib import Path

import torch
from support import strict_json

from completesplat.results.machine import machine


def test_the_machine_can_be_written_as_json(tmp_path: Path) -> None:
    (tmp_path / "machine.json").write_text(json.dumps(machine()))
    described = strict_json(tmp_path / "machine.json")
    assert described == machine()
    assert described["processor"]
    assert (described["threads"], described["torch"]) == (torch.get_num_threads(), torch.__version__)
