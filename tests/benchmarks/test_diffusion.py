"""`completesplat bench diffusion`: work and timing of the comparisons, and what the command writes and refuses."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config, refused, strict_json

from completesplat.benchmarks import diffusion
from completesplat.benchmarks.diffusion import (
    cached_vs_on_the_fly,
    chosen_of,
    measured,
)
from completesplat.benchmarks.measuring import WARM_UP
from completesplat.errors import CompleteSplatError
from completesplat.training import stage

CPU = torch.device("cpu")


def test_the_ways_take_turns_and_the_medians_of_the_later_calls_count(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr(stage, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    # Seconds of each call, the first of which counts operations; those of the warm-up are long.
    seconds = {"a": [9.0] * (1 + WARM_UP) + [1.0, 2.0, 6.0], "b": [90.0] * (1 + WARM_UP) + [40.0, 8.0, 1.0]}

    def work(key: str) -> None:
        calls.append(key)
        now[0] += seconds[key].pop(0)

    row = measured((("this", lambda: work("a")), ("that", lambda: work("b"))), 3)
    flops = {"a_tflop": 0, "b_tflop": 0}
    assert row == {"a": "this", "b": "that", "a_ms": 2000.0, "b_ms": 8000.0, "ratio": 4.0} | flops
    assert calls == ["a", "b"] * (1 + WARM_UP + 3)


def test_the_operations_of_both_ways_are_counted():
    a, b = torch.ones(20, 30), torch.ones(30, 50)
    row = measured((("once", lambda: a @ b), ("twice", lambda: a @ b @ b.T)), 1)
    assert row["a_tflop"] * 1e12 == pytest.approx(2 * 20 * 30 * 50)
    assert row["b_tflop"] == pytest.approx(2 * row["a_tflop"])


def test_comparisons_are_chosen_by_name_and_an_unknown_one_is_refused():
    assert chosen_of(["x", "y"], ["x"]) == ["x"]
    assert chosen_of(["x", "y"], None) == ["x", "y"]
    with pytest.raises(CompleteSplatError, match=r"^only=z: choose from x, y$"):
        chosen_of(["x", "y"], ["z"])


def test_a_missing_gpu_is_refused(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    line = refused("bench", "bench_task=diffusion", "device=cuda")
    assert line == "device=cuda: there is no GPU here; device=auto takes what there is"


CHANNELS = "channels=[8,8,16,16]"
SMALL = [
    *(f"autoreconstructor.encoder.{CHANNELS}", f"conditioning.{CHANNELS}", "denoiser.channels=[16,32]"),
    *("denoiser.attention_levels=[1]", "data.image_size=32", "data.batch_size=2"),
]
FROZEN = ["conditioning=stable_diffusion", "conditioning.layers_per_block=1", "conditioning.norm_groups=8"]


def prepared(toy_root, *settings: str):
    config = compose_config("bench", "bench_task=diffusion", "data.cache=true", *SMALL, *settings)
    torch.manual_seed(0)
    return instantiate(config.model, _convert_="all"), partial(
        instantiate, config.data, root=str(toy_root), _convert_="all"
    )


@pytest.mark.parametrize(
    ("settings", "trained"), [([], ["conditioning", "denoiser"]), (FROZEN, ["denoiser"])], ids=["learned", "frozen"]
)
def test_the_cache_spares_frozen_networks_and_both_ways_train_the_rest(toy_root, tmp_path, settings, trained):
    module, data = prepared(toy_root, *settings)
    comparison = cached_vs_on_the_fly(module, "32-true", data, tmp_path / "latents")
    parts, calls = module.completesplat, []
    networks = {"encoder": parts.autoreconstructor.encoder, "conditioning": parts.conditioning}
    for name, network in (networks | {"denoiser": parts.denoiser}).items():
        network.register_forward_pre_hook(lambda _, inputs, name=name: calls.append((name, len(inputs[0]))))
    for (_, work), called in zip(comparison, (trained, ["encoder", "conditioning", "denoiser"]), strict=True):
        before = {name: value.clone() for name, value in parts.named_parameters()}
        calls.clear()
        work()
        assert calls == [(name, 2) for name in called]
        changed = [name for name, value in parts.named_parameters() if not torch.equal(value, before[name])]
        assert {name.split(".")[0] for name in changed} == set(trained)


@pytest.mark.slow
def test_all_comparisons_are_measured_written_and_printed(command, tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # starting workers costs more than writing a few images
    monkeypatch.setattr(diffusion, "WARM_UP", 1)
    quick = ["repeats=2", "device=cpu", "precision=32-true", "samples=3", "steps=2", "sampler.steps=2", "few.steps=1"]
    out, scenes = tmp_path / "out", ["data.scenes=4", "data.frames=2"]
    finished = command("bench", "diffusion", *SMALL, *quick, *scenes, f"out={out}")
    assert finished.status == 0, finished.err
    assert finished.out.splitlines()[-1] == str(out)
    results = strict_json(out / "diffusion.json")
    assert set(results) == {"machine", "workload", "rows"}
    assert results["workload"] == {"device": "cpu", "precision": "32-true", "image_size": 32, "batch": 2}
    names = ["cached_vs_on_the_fly", "batch_vs_one_by_one_k3", "unguided_vs_guided", "few_steps_vs_50"]
    assert [row["name"] for row in results["rows"]] == names
    assert (results["rows"][3]["a"], results["rows"][3]["b"]) == ("UniPC, 1 step", "DDIM, 50 steps")
    texts = ("one by one", "UniPC, 1 step", "32 x 32 pixels, batch 2", results["machine"]["processor"])
    assert all(text in finished.out for text in texts)
    assert not list(out.glob("bench_diffusion_*"))
