"""`completesplat bench paper`: what it writes, prints and refuses."""

import os
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from support import compose_config, strict_json

from completesplat.benchmarks import paper
from completesplat.benchmarks.paper import COMPUTE_MODES, FIGURES, compile_networks, is_as_in_the_paper, time_and_memory
from completesplat.settings.checks import complete_task

CHANNELS = "channels=[8,8,16,16]"
QUICK = [
    *("bench", "paper", "repeats=1", "device=cpu", "compile=false", "samples=3", "sampler.steps=2"),
    *("autoreconstructor=tiny", "conditioning=learned", "denoiser=tiny", "rasterizer=tiled"),
    *(f"autoreconstructor.encoder.{CHANNELS}", f"conditioning.{CHANNELS}", "denoiser.channels=[16,32]"),
    *("denoiser.attention_levels=[1]", "data.scenes=4", "data.frames=4", "data.image_size=32", "data.batch_size=2"),
]


@pytest.mark.slow
def test_both_stages_are_measured_written_and_printed(command, tmp_path, monkeypatch):
    # Starting workers costs more than writing a few images.
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    monkeypatch.setattr(paper, "WARM_UP", 0)
    finished = command.succeeds(*QUICK, f"out={tmp_path / 'out'}")
    results = strict_json(tmp_path / "out/paper.json")
    stages = (["reconstruct", "render", "stage1_step"], ["sample", "samples", "stage2_step"])
    works = [(name, way) for names in stages for way in ("float32", "bfloat16") for name in names]
    assert [(row["name"], row["way"]) for row in results["rows"]] == works
    # Less work than the paper's, so its durations do not stand beside these.
    assert all(set(row) == {"name", "way", "ms"} and row["ms"] > 0 for row in results["rows"])
    work = {"device": "cpu", "image_size": 32, "batch": 2, "samples": 3, "steps": 2, "repeats": 1}
    assert results["workload"] == work
    assert all(figure.text in finished.out for figure in FIGURES.values())
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")


def papers_work(*settings: str) -> bool:
    """Return whether these settings give the work of the paper's durations."""
    config = compose_config("bench", "bench_task=paper", *settings)
    complete_task(config)
    task = OmegaConf.to_container(config.task, resolve=True)
    data = task["data"]
    work = {"image_size": data["image_size"], "batch": data["batch_size"]}
    return is_as_in_the_paper(work | {key: task[key] for key in ("samples", "steps")}, task["channels"])


def test_the_work_is_the_papers_unless_something_is_changed():
    assert papers_work()
    for change in ("samples=4", "data.image_size=64", "sampler=dpm20", "denoiser=tiny", "autoreconstructor=tiny"):
        assert not papers_work(change)


def test_networks_are_compiled_in_the_way_s_mode(monkeypatch):
    modes = []
    monkeypatch.setattr(torch, "compile", lambda call, mode: modes.append(mode) or call)
    for way in COMPUTE_MODES:
        network = torch.nn.Linear(1, 1)
        compile_networks([network], way)
        assert (network._compiled_call_impl is not None) == (way.compile is not None)
    assert modes == ["default", "reduce-overhead"]


def test_failing_work_has_the_reason_in_its_row():
    def fail() -> None:
        raise RuntimeError("out of memory\nand a long story")

    assert time_and_memory(fail, 1, torch.device("cpu")) == {"not_measured": "RuntimeError: out of memory"}


def children() -> int:
    return len(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


@pytest.mark.processes
def test_work_is_measured_beside_busy_processes_which_end_with_it():
    busy = []

    def work() -> None:
        busy.append(children())

    row = time_and_memory(work, 2, torch.device("cpu"), busy=3)
    assert busy == [0] * (paper.WARM_UP + 2) + [3] * 2
    assert row["times"] == row["busy_ms"] / row["ms"]
    assert children() == 0
