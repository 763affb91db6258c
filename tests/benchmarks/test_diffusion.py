"""What stage 2 costs: what is compared, how it is timed, and what the command writes, says and refuses."""

import time
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

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
    chosen_of,
    comparisons,
    compiled_vs_eager,
    drawn_compiled_vs_eager,
    measured,
)
from completesplat.errors import CompleteSplatError
from completesplat.generator import CompleteSplat
from completesplat.scene import CachedScene, SceneBatch

CPU = torch.device("cpu")


def test_the_ways_take_turns_and_the_medians_of_the_later_calls_count(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr(diffusion, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    # Seconds of each call; those of the warm-up are long.
    seconds = {"a": [9.0] * WARM_UP + [1.0, 2.0, 6.0], "b": [90.0] * WARM_UP + [40.0, 8.0, 1.0]}

    def work(key: str) -> None:
        calls.append(key)
        now[0] += seconds[key].pop(0)

    comparison = Comparison("x", ("this", lambda: work("a")), ("that", lambda: work("b")), counted=False)
    row = measured(comparison, 3, torch.device("cpu"))
    assert row == {"name": "x", "a": "this", "b": "that", "a_ms": 2000.0, "b_ms": 8000.0, "ratio": 4.0}
    assert calls == ["a", "b"] * (WARM_UP + 3)


def test_the_operations_of_both_ways_are_counted():
    one, other = torch.ones(20, 30), torch.ones(30, 50)
    row = measured(Comparison("x", ("once", lambda: one @ other), ("twice", lambda: one @ other @ other.T)), 1, CPU)
    assert row["a_tflop"] * 1e12 == pytest.approx(2 * 20 * 30 * 50)
    assert row["b_tflop"] == pytest.approx(2 * row["a_tflop"])


class Wrapped(nn.Module):
    """What torch.compile gives, but for the compiling."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.latent_channels = network.latent_channels
        self.calls = 0

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.network(*inputs)


def test_both_ways_pass_the_same_through_the_denoiser_forward_and_backward(monkeypatch):
    model, wrapped, seen, gradients = tiny_generator(), [], [], []
    monkeypatch.setattr(torch, "compile", lambda network, **_: wrapped.append(Wrapped(network)) or wrapped[0])
    comparison = compiled_vs_eager(model, 3, "32-true", 60)
    assert wrapped[0].calls == 1  # which compiles
    model.denoiser.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    next(model.denoiser.parameters()).register_hook(lambda gradient: gradients.append(gradient.clone()))
    for _, work in (comparison.a, comparison.b):
        work()
        assert wrapped[0].calls == 2
    for one, other in zip(*seen, strict=True):
        assert torch.equal(one, other)
    torch.testing.assert_close(*gradients)
    assert gradients[0].any()


def test_both_ways_draw_the_same_and_the_model_keeps_its_denoiser(monkeypatch):
    model, wrapped, seen, asked = tiny_generator(), [], [], []

    def compile(network: nn.Module, **settings: object) -> nn.Module:
        asked.append(settings)
        wrapped.append(Wrapped(network))
        return wrapped[0]

    monkeypatch.setattr(torch, "compile", compile)
    denoiser = model.denoiser
    comparison = drawn_compiled_vs_eager(model, 3, 2, 60)
    assert asked == [{}]  # CUDA graphs are a GPU's
    assert wrapped[0].calls == 2  # which compiles
    assert model.denoiser is denoiser
    reconstructor = model.autoreconstructor.reconstructor
    reconstructor.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    for _, work in (comparison.a, comparison.b):
        work()
        assert wrapped[0].calls == 4
        assert model.denoiser is denoiser
    assert len(seen[0]) == 3
    assert torch.equal(*seen)


def test_only_some_are_measured_and_an_unknown_one_is_refused():
    prepared = {"x": lambda: Comparison("x", ("", list), ("", list)), "y": lambda: pytest.fail("not asked for")}
    assert list(chosen_of(prepared, ["x"])) == ["x"]
    assert list(chosen_of(prepared, None)) == ["x", "y"]
    with pytest.raises(CompleteSplatError, match=r"^only=z: choose from x, y$"):
        chosen_of(prepared, ["z"])


@pytest.mark.parametrize("stubborn", [False, True])
def test_compiling_that_takes_too_long_is_given_up(monkeypatch, stubborn):
    """Even where it handles the error that ends it."""
    ended = []

    def sleep(*_: object) -> None:
        try:
            time.sleep(60)
        except Exception:
            if not stubborn:
                raise
            time.sleep(60)
        ended.append(True)

    def compile(network: nn.Module) -> nn.Module:
        network.register_forward_pre_hook(sleep)
        return network

    monkeypatch.setattr(torch, "compile", compile)
    with pytest.raises(NotMeasured, match=r"took longer than compile_limit=0\.2 s"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0.2)
    assert ended == []


@pytest.fixture(scope="module")
def compared() -> tuple[CompleteSplat, dict[str, Comparison]]:
    model, few = tiny_generator(), compose_config("fit", "sampler=dpm10", "sampler.steps=3").sampler
    return model, {found.name: found for found in comparisons(model, few, samples=4, steps=2, batch=3)}


def drawn(model: CompleteSplat, work: Callable[[], object]) -> tuple[list[int], ...]:
    """Batch sizes of the calls of the encoder, the denoiser and the reconstructor."""
    frozen = model.autoreconstructor
    networks = frozen.encoder.network.conv_in, model.denoiser, frozen.reconstructor
    seen: tuple[list[int], ...] = [], [], []
    hooks = [
        network.register_forward_pre_hook(lambda _, inputs, sizes=sizes: sizes.append(len(inputs[0])))
        for network, sizes in zip(networks, seen, strict=True)
    ]
    work()
    for hook in hooks:
        hook.remove()
    return seen


@pytest.mark.parametrize(
    ("name", "a", "b"),
    [
        ("batch_vs_one_by_one_k4", ([1], [4] * 2, [4]), ([1], [1] * 2 * 4, [1] * 4)),
        ("unguided_vs_guided", ([3], [3] * 2, [3]), ([3], [6] * 2, [3])),
        ("few_steps_vs_50", ([3], [3] * 3, [3]), ([3], [3] * 50, [3])),
    ],
)
def test_what_passes_through_the_networks(compared, name, a, b):
    model, comparisons = compared
    assert drawn(model, comparisons[name].a[1]) == a
    assert drawn(model, comparisons[name].b[1]) == b


def test_few_steps_are_of_the_sampler_that_is_given_and_fifty_of_the_models(compared):
    comparison = compared[1]["few_steps_vs_50"]
    assert (comparison.a[0], comparison.b[0]) == ("DPMSolver, 3 steps", "DDIM, 50 steps")
    assert "DDIM" in compared[0].architecture["sampler"]["scheduler"]["_target_"]  # the model keeps its own


CHANNELS = "channels=[8,8,16,16]"
SMALL = [
    *(f"autoreconstructor.encoder.{CHANNELS}", f"conditioning.{CHANNELS}", "denoiser.channels=[16,32]"),
    *("denoiser.attention_levels=[1]", "data.image_size=32", "data.batch_size=2"),
]
FROZEN = ["conditioning=stable_diffusion", "conditioning.layers_per_block=1", "conditioning.norm_groups=8"]


def prepared(toy_root, *settings: str):
    config = compose_config("bench", "bench_task=diffusion", "data.cache=true", *SMALL, *settings)
    torch.manual_seed(0)
    training = Training(instantiate(config.model, _convert_="all"), "32-true")
    return training, partial(instantiate, config.data, root=str(toy_root), _convert_="all")


@pytest.mark.parametrize(
    ("settings", "trained"), [([], ["conditioning", "denoiser"]), (FROZEN, ["denoiser"])], ids=["learned", "frozen"]
)
def test_the_cache_spares_what_is_frozen_and_both_ways_train_the_rest(toy_root, tmp_path, settings, trained):
    training, data = prepared(toy_root, *settings)
    comparison = cached_vs_on_the_fly(training, data, tmp_path / "latents")
    parts, calls = training.module.completesplat, []
    networks = {"encoder": parts.autoreconstructor.encoder, "conditioning": parts.conditioning}
    for name, network in (networks | {"denoiser": parts.denoiser}).items():
        network.register_forward_pre_hook(lambda _, inputs, name=name: calls.append((name, len(inputs[0]))))
    for (_, work), called in ((comparison.a, trained), (comparison.b, ["encoder", "conditioning", "denoiser"])):
        before = {name: value.clone() for name, value in parts.named_parameters()}
        calls.clear()
        work()
        assert calls == [(name, 2) for name in called]
        changed = [name for name, value in parts.named_parameters() if not torch.equal(value, before[name])]
        assert {name.split(".")[0] for name in changed} == set(trained)


def test_both_ways_load_a_batch_for_each_step_and_pictures_only_once(toy_root, tmp_path, monkeypatch):
    training, data = prepared(toy_root)
    given = []
    monkeypatch.setattr(Training, "step", lambda self, batch: given.append(batch))
    comparison = cached_vs_on_the_fly(training, data, tmp_path / "latents")
    monkeypatch.setattr("completesplat.data.images.crop.decode", lambda *_: pytest.fail("decoded again"))
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


@pytest.mark.slow
def test_what_can_be_measured_is_written_and_shown(command, tmp_path, monkeypatch):
    def fail(network: torch.nn.Module) -> None:
        raise RuntimeError("no C++ compiler\nand a long story")

    monkeypatch.setattr("os.cpu_count", lambda: 1)  # so few pictures are sooner written by this process alone
    monkeypatch.setattr(diffusion, "WARM_UP", 1)
    monkeypatch.setattr(torch, "compile", fail)
    quick = ["repeats=2", "device=cpu", "precision=32-true", "samples=3", "steps=2", "sampler.steps=2", "few.steps=1"]
    out, scenes = tmp_path / "out", ["data.scenes=4", "data.frames=2"]
    finished = command("bench", "diffusion", *SMALL, *quick, *scenes, f"out={out}")
    assert finished.status == 0, finished.err
    assert finished.out.splitlines()[-1] == str(out)
    results = strict_json(out / "diffusion.json")
    assert set(results) == {"machine", "workload", "rows", "not_measured"}
    reason = "torch.compile failed: RuntimeError: no C++ compiler"
    assert results["not_measured"] == dict.fromkeys(["compiled_vs_eager", "drawn_compiled_vs_eager"], reason)
    assert results["workload"] == {"device": "cpu", "precision": "32-true", "image_size": 32, "batch": 2}
    names = ["cached_vs_on_the_fly", "batch_vs_one_by_one_k3", "unguided_vs_guided", "few_steps_vs_50"]
    assert [row["name"] for row in results["rows"]] == names
    for row in results["rows"]:
        assert min(row["a_ms"], row["b_ms"]) > 0
        assert row["ratio"] == pytest.approx(row["b_ms"] / row["a_ms"])
    assert (results["rows"][3]["a"], results["rows"][3]["b"]) == ("UniPC, 1 step", "DDIM, 50 steps")
    said = ("one by one", "UniPC, 1 step", "32 x 32 pixels, batch 2", results["machine"]["processor"])
    assert all(text in finished.out for text in (*said, f"compiled_vs_eager: not measured, because {reason}"))
    assert not list(out.glob("bench_diffusion_*"))


def test_a_refusal_is_one_line_and_status_two(command, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    finished = command("bench", "diffusion", "device=cuda", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert finished.err == "error: device=cuda: there is no GPU here; device=auto takes what there is\n"


def test_why_nothing_is_compiled_is_said_in_one_line(monkeypatch):
    def fail(network: nn.Module) -> None:
        raise RuntimeError("no compiler\nat all")

    monkeypatch.setattr(torch, "compile", fail)
    for limit, reason in ((0, r"^compile_limit=0$"), (60, r"^torch\.compile failed: RuntimeError: no compiler$")):
        with pytest.raises(NotMeasured, match=reason):
            compiled_vs_eager(tiny_generator(), 1, "32-true", limit)
