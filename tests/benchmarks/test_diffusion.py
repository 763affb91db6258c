"""What stage 2 costs: what is compared, how it is timed, and what the command writes, says and refuses."""

import time
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config, strict_json, tiny_generator
from torch import nn

from completesplat.benchmarks import diffusion
from completesplat.benchmarks.diffusion import (
    WARM_UP,
    Comparison,
    NotMeasured,
    Training,
    batches,
    cached_vs_on_the_fly,
    comparisons,
    compiled_vs_eager,
    measured,
)
from completesplat.generation import CompleteSplat
from completesplat.scene import CachedScene, SceneBatch


def test_the_ways_take_turns_and_the_medians_of_the_later_calls_count(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr(diffusion, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    # Seconds of each call; those of the warm-up are long.
    seconds = {"a": [9.0] * WARM_UP + [1.0, 2.0, 6.0], "b": [90.0] * WARM_UP + [40.0, 8.0, 1.0]}

    def work(key: str) -> None:
        calls.append(key)
        now[0] += seconds[key].pop(0)

    comparison = Comparison("x", ("this", lambda: work("a")), ("that", lambda: work("b")))
    row = measured(comparison, 3, torch.device("cpu"))
    assert row == {"name": "x", "a": "this", "b": "that", "a_ms": 2000.0, "b_ms": 8000.0, "ratio": 4.0}
    assert calls == ["a", "b"] * (WARM_UP + 3)


class Wrapped(nn.Module):
    """What torch.compile gives, but for the compiling."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.calls = 0

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.network(*inputs)


def test_both_ways_pass_the_same_through_the_denoiser_forward_and_backward(monkeypatch):
    model, wrapped, seen, gradients = tiny_generator(), [], [], []
    monkeypatch.setattr(torch, "compile", lambda network: wrapped.append(Wrapped(network)) or wrapped[0])
    comparison = compiled_vs_eager(model, 3, "32-true", 60)
    assert wrapped[0].calls == 1  # which compiles
    model.denoiser.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    next(model.denoiser.parameters()).register_hook(lambda gradient: gradients.append(gradient.clone()))
    comparison.a[1]()
    assert wrapped[0].calls == 2
    comparison.b[1]()
    assert wrapped[0].calls == 2
    assert len(seen) == len(gradients) == 2
    for one, other in zip(*seen, strict=True):
        assert len(one) == 3
        assert torch.equal(one, other)
    torch.testing.assert_close(*gradients)
    assert gradients[0].any()


@pytest.mark.parametrize("stubborn", [False, True])
def test_compiling_that_takes_too_long_is_given_up(monkeypatch, stubborn):
    """Even where it handles the error that ends it."""

    def sleep(*_: object) -> None:
        try:
            time.sleep(60)
        except Exception:
            if not stubborn:
                raise
            time.sleep(60)

    def compile(network: nn.Module) -> nn.Module:
        network.register_forward_pre_hook(sleep)
        return network

    monkeypatch.setattr(torch, "compile", compile)
    start = time.monotonic()
    with pytest.raises(NotMeasured, match=r"took longer than compile_limit=0\.2 s"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0.2)
    assert time.monotonic() - start < 30


def test_an_error_gives_the_reason_in_one_line(monkeypatch):
    def compile(network: nn.Module) -> nn.Module:
        raise RuntimeError("no compiler\nat all")

    monkeypatch.setattr(torch, "compile", compile)
    with pytest.raises(NotMeasured, match=r"^torch\.compile failed: RuntimeError: no compiler$"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 60)


FEW = compose_config("fit", "sampler=dpm10", "sampler.steps=3").sampler


class Drawn(NamedTuple):
    """Batch sizes of the calls of each network."""

    encoder: list[int]
    denoiser: list[int]
    reconstructor: list[int]


@pytest.fixture(scope="module")
def model() -> CompleteSplat:
    return tiny_generator()


@pytest.fixture(scope="module")
def compared(model) -> dict[str, Comparison]:
    return {comparison.name: comparison for comparison in comparisons(model, FEW, samples=4, steps=2, batch=3)}


def drawn(model: CompleteSplat, work: Callable[[], object]) -> Drawn:
    seen = Drawn([], [], [])
    networks: list[nn.Module] = [
        model.autoreconstructor.encoder,
        model.denoiser,
        model.autoreconstructor.reconstructor,
    ]
    hooks = [
        network.register_forward_pre_hook(lambda _, inputs, sizes=sizes: sizes.append(len(inputs[0])))
        for network, sizes in zip(networks, seen, strict=True)
    ]
    work()
    for hook in hooks:
        hook.remove()
    return seen


def test_samples_of_one_picture_in_a_batch_and_one_by_one(model, compared):
    comparison = compared["batch_vs_one_by_one_k4"]
    assert drawn(model, comparison.a[1]) == Drawn([1], [4] * 2, [4])
    # By turns: a sample is denoised and reconstructed before the next.
    assert drawn(model, comparison.b[1]) == Drawn([1], [1] * 2 * 4, [1] * 4)


def test_guidance_doubles_the_denoisers_batch_and_nothing_else(model, compared):
    comparison = compared["unguided_vs_guided"]
    steps = model.sampler.steps
    assert drawn(model, comparison.a[1]) == Drawn([3], [3] * steps, [3])
    assert drawn(model, comparison.b[1]) == Drawn([3], [6] * steps, [3])


def test_few_steps_are_of_the_sampler_that_is_given_and_fifty_of_the_models(model, compared):
    comparison = compared["few_steps_vs_50"]
    assert (comparison.a[0], comparison.b[0]) == ("DPMSolver, 3 steps", "DDIM, 50 steps")
    assert drawn(model, comparison.a[1]) == Drawn([3], [3] * 3, [3])
    assert type(model.sampler.scheduler).__name__ == "DPMSolverMultistepScheduler"
    assert drawn(model, comparison.b[1]) == Drawn([3], [3] * 50, [3])
    assert type(model.sampler.scheduler).__name__ == "DDIMScheduler"
    assert "DDIM" in model.architecture["sampler"]["scheduler"]["_target_"]  # the model keeps its own


SMALL = [
    "bench_task=diffusion",
    "autoreconstructor.encoder.channels=[8,8,16,16]",
    "denoiser.channels=[16,32]",
    "denoiser.attention_levels=[1]",
    *("data.image_size=32", "data.batch_size=2", "data.cache=true"),
]
LEARNED = ["conditioning.channels=[8,8,16,16]"]
FROZEN = [
    "conditioning=stable_diffusion",
    "conditioning.channels=[8,8,16,16]",
    "conditioning.layers_per_block=1",
    "conditioning.norm_groups=8",
]


def prepared(toy_root, *settings: str):
    config = compose_config("bench", *SMALL, *settings)
    torch.manual_seed(0)
    training = Training(instantiate(config.model, _convert_="all"), "32-true")
    return training, partial(instantiate, config.data, root=str(toy_root), _convert_="all")


@pytest.mark.parametrize(("settings", "on_cached"), [(LEARNED, 1), (FROZEN, 0)], ids=["learned", "frozen"])
def test_the_cache_spares_the_encoders_that_are_frozen_and_the_reading(toy_root, tmp_path, settings, on_cached):
    training, data = prepared(toy_root, *settings)
    comparison = cached_vs_on_the_fly(training, data, tmp_path / "latents")
    parts, calls = training.module.completesplat, []
    for name, network in {
        "encoder": parts.autoreconstructor.encoder,
        "conditioning": parts.conditioning,
        "denoiser": parts.denoiser,
    }.items():
        network.register_forward_pre_hook(lambda _, inputs, name=name: calls.append((name, len(inputs[0]))))
    comparison.a[1]()
    assert calls == [("conditioning", 2)] * on_cached + [("denoiser", 2)]
    calls.clear()
    comparison.b[1]()
    assert calls == [("encoder", 2), ("conditioning", 2), ("denoiser", 2)]


@pytest.mark.parametrize("way", ["a", "b"])
def test_both_ways_train_what_is_trainable_and_nothing_else(toy_root, tmp_path, way):
    training, data = prepared(toy_root, *LEARNED)
    comparison = cached_vs_on_the_fly(training, data, tmp_path / "latents")
    parts = training.module.completesplat
    before = {name: value.clone() for name, value in parts.named_parameters()}
    getattr(comparison, way)[1]()
    changed = {name.split(".")[0] for name, value in parts.named_parameters() if not torch.equal(value, before[name])}
    assert changed == {"conditioning", "denoiser"}


def test_both_ways_load_a_batch_for_each_step_and_pictures_only_once(toy_root, tmp_path, monkeypatch):
    training, data = prepared(toy_root, *LEARNED)
    given = []
    monkeypatch.setattr(Training, "step", lambda self, batch: given.append(batch))
    comparison = cached_vs_on_the_fly(training, data, tmp_path / "latents")
    monkeypatch.setattr("completesplat.data.pictures.crop.decode", lambda *_: pytest.fail("decoded again"))
    for _ in range(5):
        comparison.a[1]()
        comparison.b[1]()
    assert [type(batch) for batch in given] == [CachedScene, SceneBatch] * 5
    for cached, fly in zip(given[::2], given[1::2], strict=True):
        assert (cached.names, cached.reference_frame.tolist()) == (fly.names, fly.reference_frame.tolist())


def test_batches_go_on_through_the_epochs_and_are_all_full(toy_root):
    _, data = prepared(toy_root)
    module = data()
    stream = batches(module)
    per_epoch = len(module.train_dataloader())
    taken = [next(stream) for _ in range(3 * per_epoch)]
    assert {len(batch.names) for batch in taken} == {2}
    views = [(batch.names, batch.reference_frame.tolist()) for batch in taken]
    assert views[:per_epoch] != views[per_epoch : 2 * per_epoch]


CHANNELS = "channels=[8,8,16,16]"
QUICK = [
    *("bench", "diffusion", "repeats=2", "device=cpu", "precision=32-true", "samples=3", "steps=2"),
    *(f"autoreconstructor.encoder.{CHANNELS}", f"conditioning.{CHANNELS}", "denoiser.channels=[16,32]"),
    *("denoiser.attention_levels=[1]", "sampler.steps=2", "few.steps=1"),
    *("data.scenes=4", "data.frames=2", "data.image_size=32", "data.batch_size=2"),
]
NAMES = ["cached_vs_on_the_fly", "batch_vs_one_by_one_k3", "unguided_vs_guided", "few_steps_vs_50", "compiled_vs_eager"]


@pytest.fixture
def in_this_process(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # so few pictures are sooner written by this process alone
    monkeypatch.setattr(diffusion, "WARM_UP", 1)


@pytest.mark.slow
def test_everything_is_measured_written_and_shown(in_this_process, command, tmp_path, monkeypatch):
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
    assert (results["rows"][3]["a"], results["rows"][3]["b"]) == ("UniPC, 1 step", "DDIM, 50 steps")
    for said in ("one by one", "UniPC, 1 step", "32 x 32 pixels, batch 2", results["machine"]["processor"]):
        assert said in finished.out
    assert not list((tmp_path / "out").glob("bench_diffusion_*"))


@pytest.mark.slow
def test_what_cannot_be_compiled_here_is_named_with_the_reason(in_this_process, command, tmp_path, monkeypatch):
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


def test_a_refusal_is_one_line_and_status_two(command, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    finished = command(*QUICK, "device=cuda", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert finished.err == "error: device=cuda: there is no GPU here; device=auto takes what there is\n"
    assert not list((tmp_path / "out").glob("*diffusion*"))


def test_without_a_limit_nothing_is_compiled(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda network: pytest.fail("compiled"))
    with pytest.raises(NotMeasured, match="compile_limit=0"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0)
