"""`completesplat bench startup`: processes take turns."""

import pytest
from support import strict_json

from completesplat.benchmarks import startup
from completesplat.errors import CompleteSplatError


def test_programs_take_turns_after_a_round_that_does_not_count(monkeypatch):
    started = []

    def run(arguments, first_line=False):
        started.append((*arguments[2:3], first_line))
        return "a line\n[0.5, 0.75]\n"

    monkeypatch.setattr(startup, "_run", run)
    times = startup.timed({startup.PREDICT: ["predict"], startup.VIEW: ["view"]}, 2)
    assert started == 3 * [(False,), ("predict", False), ("view", True), ("predict", False)]
    assert times["predict once more"] == (0.5, 0.75)


@pytest.mark.slow
def test_processes_are_timed_written_and_printed(command, tmp_path):
    finished = command("bench", "startup", "repeats=1", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    rows = {row["what"]: row for row in strict_json(tmp_path / "out/startup.json")["rows"]}
    torch, predict, again = (rows[name] for name in ("import torch", "predict", "predict once more"))
    assert torch["times_torch"] == 1
    assert 0 < again["cpu_seconds"] < predict["cpu_seconds"]
    assert predict["cpu_seconds"] > torch["cpu_seconds"] > 0
    assert "from a cold start" in finished.out


@pytest.mark.processes
def test_a_process_that_fails_is_refused():
    with pytest.raises(CompleteSplatError, match="a process that was timed has failed: error: no weights"):
        startup._run(["-c", "import sys; sys.exit('a line\\nerror: no weights')"])
