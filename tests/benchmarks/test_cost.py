"""`completesplat bench cost`: days of a training by the steps that were measured."""

import json

import pytest
from support import refused, strict_json

MACHINE = {"processor": "P", "cores": 1, "threads": 1, "system": "Linux", "gpu": "G"}
MACHINE |= {"python": "3", "torch": "2", "date": "today"}
WORK = {"device": "cuda", "image_size": 128, "batch": 32, "samples": 20, "steps": 50, "repeats": 1}
ROWS = [
    {"name": "stage1_step", "way": "float32", "ms": 864.0, "memory_mb": 5000.0},
    {"name": "stage1_step", "way": "bfloat16", "not_measured": "out of memory"},
    {"name": "stage2_step", "way": "float32", "ms": 86.4},
    {"name": "render", "way": "float32", "ms": 1.0},
]


@pytest.fixture
def measured(tmp_path):
    path = tmp_path / "paper.json"
    path.write_text(json.dumps({"machine": MACHINE, "workload": WORK, "rows": ROWS}))
    return path


def test_days_are_steps_times_their_duration(command, measured, tmp_path):
    finished = command("bench", "cost", f"measured={measured}", "gpus=[1,4]", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    rows = strict_json(tmp_path / "out/cost.json")["rows"]
    assert [(row["training"], row["days_1"], row["days_4"]) for row in rows] == [
        ("AutoReconstructor, hydrants", pytest.approx(3.15), pytest.approx(3.15 / 4)),
        ("AutoReconstructor, teddy bears", pytest.approx(5.80), pytest.approx(1.45)),
        ("latent diffusion", pytest.approx(1.10), pytest.approx(0.275)),
    ]
    assert [row.get("memory_mb") for row in rows] == [5000, 5000, None]
    for figure in ("3.1", "5.8", "1.1", "315,000"):
        assert figure in finished.out


def test_other_files_are_refused(measured):
    nothing = measured.with_name("nothing.json")
    for text in ("[]", "{", '{"rows": []}'):
        nothing.write_text(text)
        assert "no result of bench paper" in refused("bench", "bench_task=cost", f"measured={nothing}")
    assert "FileNotFoundError" in refused("bench", "bench_task=cost", "measured=nowhere.json")
    measured.write_text(json.dumps({"machine": MACHINE, "workload": WORK, "rows": ROWS[1:2] + ROWS[3:]}))
    assert "has no training steps" in refused("bench", "bench_task=cost", f"measured={measured}")
