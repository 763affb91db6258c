"""`completesplat bench startup`: processes in turn, and what their imports cost."""

import subprocess

import pytest
from support import refused, strict_json
from written_commands import ROOT

from completesplat.benchmarks import startup
from completesplat.errors import CompleteSplatError

# As `python -X importtime` writes it: a module behind those that it imports.
TORCHS = """
import time: self [us] | cumulative | imported package
import time:       500 |        500 |   numpy
import time:       900 |       1400 | torch
"""
OURS = f"""
{TORCHS.strip()}
rasterizer: tiled
import time:      3000 |       3000 |       torch._dynamo
import time:      1000 |       4000 |     diffusers.utils
import time:      2000 |       6000 |   diffusers
import time:       700 |        700 |     kornia
import time:       250 |        950 |   completesplat.data
import time:       150 |       7100 | completesplat.cli
"""


@pytest.fixture
def processes(monkeypatch):
    """Those that would be started, which come to an end at once."""
    started = []

    def run(arguments, package, first_line=False):
        started.append((*arguments[2:3], package, first_line))
        printed = TORCHS if "import torch" in arguments else OURS
        return subprocess.CompletedProcess(arguments, 0, "a line\n[0.5, 0.75]\n", printed)

    monkeypatch.setattr(startup, "_run", run)
    return started


def test_a_package_costs_what_it_has_and_what_is_imported_within_it(processes):
    known = {module.name for module in startup.imported_by(["-c", "import torch"])}
    assert known == {"numpy", "torch"}
    found = startup.costs(startup.imported_by(["-m", "completesplat"]), known)
    assert [(row["package"], row["own_ms"], row["ms"]) for row in found] == [
        ("diffusers", pytest.approx(3), pytest.approx(6)),
        ("torch", pytest.approx(3), pytest.approx(3)),
        ("kornia", pytest.approx(0.7), pytest.approx(0.7)),
        ("completesplat", pytest.approx(0.4), pytest.approx(0.4)),
    ]


def test_versions_take_turns_after_a_round_that_does_not_count(processes):
    found = startup.timed({startup.PREDICT: ["predict"], startup.VIEW: ["view"]}, 2, ROOT)
    predict, view = ("predict", None, False), ("view", None, True)
    others = [(name, ROOT, first_line) for name, _, first_line in (predict, view)]
    assert processes == 3 * [(None, False), (None, False), others[0], predict, others[1], view, predict]
    assert found["predict once more"] == (0.5, 0.75)
    assert {name for name in found if name.endswith(", other version")} == {
        "predict, other version",
        "view, until its page is there, other version",
    }


@pytest.mark.slow
def test_processes_are_timed_written_and_shown(command, tmp_path):
    finished = command("bench", "startup", "repeats=1", "packages=3", f"against={ROOT}", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    results = strict_json(tmp_path / "out/startup.json")
    found = {row["what"]: row for row in results["rows"]}
    names = ("import torch", "predict, other version", "predict", "predict once more")
    torch, other, predict, again = (found[name] for name in names)
    assert torch["times_torch"] == 1
    assert 0 < again["cpu_seconds"] < predict["cpu_seconds"]
    assert other["cpu_seconds"] > torch["cpu_seconds"] > 0
    assert {row["package"] for row in results["imports"]} >= {"diffusers", "torch"}
    for text in ("from a cold start", "beyond those of torch", "diffusers", "times import torch"):
        assert text in finished.out


def test_no_package_and_a_process_that_fails_are_refused(tmp_path):
    assert "no completesplat/ here" in refused("bench", "bench_task=startup", f"against={tmp_path}")
    with pytest.raises(CompleteSplatError, match="a process that was timed has failed: error: no weights"):
        startup._run(["-c", "import sys; sys.exit('a line\\nerror: no weights')"], None)
