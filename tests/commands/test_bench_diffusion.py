"""`completesplat bench diffusion`: what it writes, says and refuses."""

import pytest
import torch
from support import strict_json

from completesplat.benchmarks import diffusion

CHANNELS = "channels=[8,8,16,16]"
QUICK = [
    *("bench", "diffusion", "repeats=2", "device=cpu", "precision=32-true", "samples=3", "steps=2"),
    *(f"autoreconstructor.encoder.{CHANNELS}", f"conditioning.{CHANNELS}", "denoiser.channels=[16,32]"),
    *("denoiser.attention_levels=[1]", "sampler.steps=2", "few.steps=1"),
    *("data.scenes=4", "data.frames=2", "data.image_size=32", "data.batch_size=2"),
]
NAMES = ["cached_vs_on_the_fly", "batch_vs_one_by_one_k3", "unguided_vs_guided", "few_steps_vs_50", "compiled_vs_eager"]


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # so few pictures are sooner written by this process alone
    monkeypatch.setattr(diffusion, "WARM_UP", 1)


@pytest.mark.slow
def test_everything_is_measured_written_and_shown(command, tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda network: network)  # which would take a minute
    finished = command(*QUICK, f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    results = strict_json(tmp_path / "out/diffusion.json")
    assert set(results) == {"machine", "workload", "rows", "not_measured"}
    assert results["not_measured"] == {}
    assert results["workload"] == {"device": "cpu", "precision": "32-true", "image_size": 32, "batch": 2}
    assert [row["name"] for row in results["rows"]] == NAMES
    for row in results["rows"]:
        assert set(row) == {"name", "a", "b", "a_ms", "b_ms", "ratio"}
        assert min(row["a_ms"], row["b_ms"]) > 0
        assert row["ratio"] == pytest.approx(row["b_ms"] / row["a_ms"])
    assert (results["rows"][3]["a"], results["rows"][3]["b"]) == ("DDIM, 1 step", "DDIM, 50 steps")
    for said in ("one by one", "DDIM, 1 step", "32 x 32 pixels, batch 2", results["machine"]["processor"]):
        assert said in finished.out
    assert not list((tmp_path / "out").glob("bench_diffusion_*"))


@pytest.mark.slow
def test_what_cannot_be_compiled_here_is_named_with_the_reason(command, tmp_path, monkeypatch):
    def fail(network: torch.nn.Module) -> None:
        raise RuntimeError("no C++ compiler\nand a long story")

    monkeypatch.setattr(torch, "compile", fail)
    finished = command(*QUICK, "repeats=1", f"out={tmp_path / 'out'}")
    assert finished.status == 0
    results = strict_json(tmp_path / "out/diffusion.json")
    assert [row["name"] for row in results["rows"]] == NAMES[:-1]
    reason = "torch.compile failed: RuntimeError: no C++ compiler"
    assert results["not_measured"] == {"compiled_vs_eager": reason}
    assert f"compiled_vs_eager: not measured, because {reason}" in finished.out


def test_help_lists_the_settings(command):
    finished = command("bench", "diffusion", "--help")
    assert finished.status == 0
    for setting in ("samples: 20", "repeats: 7", "compile_limit: 600", "steps: 5", "batch_size: 16"):
        assert setting in finished.out


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("repeats=0", "repeats=0: must be at least 1"),
        ("samples=0", "samples=0: must be at least 1"),
        ("compile_limit=-1", "compile_limit=-1: must be at least 0"),
        ("device=tpu", "device=tpu: choose one of auto, cpu, cuda"),
        ("device=cuda", "device=cuda: there is no GPU here; device=auto takes what there is"),
        ("precision=64-true", "precision=64-true: choose one of 32-true, bf16-mixed"),
    ],
)
def test_refusals_are_one_line_and_status_two(command, tmp_path, monkeypatch, argument, said):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    finished = command(*QUICK, argument, f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert finished.err == f"error: {said}\n"
    assert not list((tmp_path / "out").glob("*diffusion*"))
