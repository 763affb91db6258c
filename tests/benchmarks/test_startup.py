"""`completesplat bench startup`: processes take turns."""

import pytest
from support import refused, strict_json
from written_commands import ROOT

from completesplat.benchmarks import startup
from completesplat.errors import CompleteSplatError


def test_versions_take_turns_after_a_round_that_does_not_count(monkeypatch):
    started = []

    def run(arguments, package, first_line=False):
        started.append((*arguments[2:3], package, first_line))
        return "a line\n[0.5, 0.75]\n"

    monkeypatch.setattr(startup, "_run", run)
    times = startup.timed({startup.PREDICT: ["predict"], startup.VIEW: ["view"]}, 2, ROOT)
    predict, view = ("predict", None, False), ("view", None, True)
    others = [(name, ROOT, first_line) for name, _, first_line in (predict, view)]
    assert started == 3 * [(None, False), (None, False), others[0], predict, others[1], view, predict]
    assert times["predict once more"] == (0.5, 0.75)
    assert {name for name in times if name.endswith(", other version")} == {
        "predict, other version",
        "view, until its page is there, other version",
    }


@pytest.mark.slow
def test_processes_are_timed_written_and_printed(command, tmp_path):
    finished = command("bench", "startup", "repeats=1", f"against={ROOT}", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    rows = {row["what"]: row for row in strict_json(tmp_path / "out/startup.json")["rows"]}
    names = ("import torch", "predict, other version", "predict", "predict once more")
    torch, other, predict, again = (rows[name] for name in names)
    assert torch["times_torch"] == 1
    assert 0 < again["cpu_seconds"] < predict["cpu_seconds"]
    assert other["cpu_seconds"] > torch["cpu_seconds"] > 0
    assert all(text in finished.out for text in ("from a cold start", "times import torch"))


@pytest.mark.processes
def test_no_package_and_a_process_that_fails_are_refused(tmp_path):
    assert "no completesplat/ here" in refused("bench", "bench_task=startup", f"against={tmp_path}")
    with pytest.raises(CompleteSplatError, match="a process that was timed has failed: error: no weights"):
        startup._run(["-c", "import sys; sys.exit('a line\\nerror: no weights')"], None)
