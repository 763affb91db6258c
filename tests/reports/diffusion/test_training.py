"""Steps from the latent cache and on the fly: which networks see what, and that it is training."""

from functools import partial

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config

from completesplat.benchmarks.diffusion import Training, batches, cached_vs_on_the_fly
from completesplat.scene import CachedScene, SceneBatch

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
