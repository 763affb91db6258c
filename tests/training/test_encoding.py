"""Encoding a training set: what is stored, how latents are scaled, and which caches are refused."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from latent_caches import FRAMES, rooms, small_autoreconstructor, sound_rooms
from support import tiny_generator
from torch import nn

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.latent_cache import LatentCache
from completesplat.data.packed import writing
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.scene import CachedScene
from completesplat.tensors import stack
from completesplat.training.encoding import Moments, check_cache, encode_training_set, fingerprint, latent_draw


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return sound_rooms(tmp_path_factory.mktemp("root"))


def encode(root: Path, out: Path, model: nn.Module | None = None, **options) -> LatentCache:
    settings = {"progress": False, **options}
    return encode_training_set(model or small_autoreconstructor(), rooms(root), out, **settings)


@pytest.fixture(scope="module")
def cache(root, tmp_path_factory) -> LatentCache:
    return encode(root, tmp_path_factory.mktemp("cache"))


class Means(nn.Module):
    """A frozen conditioning: the mean of each quarter of a picture, times a weight."""

    frozen = True

    def __init__(self, weight: float = 1.0) -> None:
        super().__init__()
        self.register_buffer("weight", torch.tensor(weight))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return nn.functional.avg_pool2d(images, 8) * self.weight


def changed_where(model: nn.Module, picture: torch.Tensor, value: float) -> nn.Module:
    """The encoder multiplies the mean of one picture by `value`."""

    def change(_: nn.Module, inputs: tuple, output: tuple) -> tuple:
        posterior, features = output
        hit = torch.tensor([torch.allclose(image, picture, atol=1e-6) for image in inputs[0]])
        factor = torch.where(hit, value, 1.0).view(-1, 1, 1, 1)
        return Posterior(posterior.mean * factor, posterior.log_variance), features

    model.encoder.register_forward_hook(change)
    return model


@pytest.mark.parametrize("batch_size", [1, 7, 64])
def test_every_frame_has_the_encoders_posterior(root, tmp_path, batch_size):
    store = encode(root, tmp_path / "cache", batch_size=batch_size)
    encoder, source = small_autoreconstructor().encoder, rooms(root).source("train")
    assert list(store.sequences) == source.names
    for name in source.names:
        sequence = source.read(name)
        for frame in range(FRAMES):
            image = sequence.read(frame).image
            with torch.no_grad():
                posterior, _ = encoder(image[None] / 255)
            scene = store.scene(name, frame)
            torch.testing.assert_close(scene.mean, posterior.mean[0], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(scene.log_variance, posterior.log_variance[0], rtol=1e-4, atol=1e-5)
            assert torch.equal((255 * scene.condition).round().to(torch.uint8), image)


def test_half_precision_needs_half_the_space_and_rounds_as_it_says(root, cache, tmp_path):
    half = encode(root, tmp_path / "half", precision="float16")
    for name in ("mean", "log_variance"):
        exact, rounded = cache.arrays[name], half.arrays[name]
        assert 2 * rounded.nbytes == exact.nbytes
        assert (np.abs(rounded.astype(np.float64) - exact) <= 2.0**-11 * np.abs(exact) + 1e-7).all()
    assert half.scale == pytest.approx(cache.scale, rel=1e-3)
    assert half.scene("c1" if "c1" in half.sequences else "c2", 0).mean.dtype == torch.float32


@pytest.mark.parametrize(("magnitude", "variance", "shift"), [(0.0, 4.0, 0.0), (3.0, 1e-3, 0.0), (0.5, 0.25, 7.0)])
def test_the_scale_is_that_of_a_mixture_of_two_equal_gaussians(magnitude, variance, shift):
    """h = shift +- magnitude + sqrt(variance) * noise has variance magnitude^2 + variance."""
    moments = Moments()
    signs = np.ones((10, 2, 3, 3), np.float32) * np.array([1, -1], np.float32)[None, :, None, None]
    log_variance = np.full_like(signs, np.log(variance))
    for part in (slice(0, 3), slice(3, 10)):
        moments.add(shift + magnitude * signs[part], log_variance[part])
    assert moments.scale() == pytest.approx((magnitude**2 + variance) ** -0.5, rel=1e-5)


def test_the_scale_is_that_of_draws_within_their_error(cache):
    mean, log_variance = (torch.from_numpy(np.array(cache.arrays[n])) for n in ("mean", "log_variance"))
    torch.manual_seed(0)
    squares = torch.stack([Posterior(mean, log_variance).sample().double().square().mean() for _ in range(400)])
    expected = 1 / cache.scale**2 + mean.double().mean() ** 2
    assert abs(squares.mean() - expected) < 5 * squares.std() / 400**0.5
    # Without the posterior's variance it would be noticed.
    assert log_variance.double().exp().mean() > 20 * squares.std() / 400**0.5


def test_a_draw_from_the_cache_is_the_draw_on_the_fly(tmp_path):
    model = tiny_generator()
    model.latent_scale.fill_(0.7)
    data = rooms(sound_rooms(tmp_path / "root", image_size=32), image_size=32)
    store = encode_training_set(model.autoreconstructor, data, tmp_path / "cache", progress=False)
    batch: CachedScene = stack([store.scene(name, 2) for name in store.sequences])
    torch.manual_seed(5)
    on_the_fly = model.encode(batch.condition).latent
    torch.manual_seed(5)
    torch.testing.assert_close(latent_draw(batch, model.latent_scale), on_the_fly, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("value", "precision"),
    [(float("nan"), "float32"), (float("inf"), "float32"), (1e30, "float16")],
    ids=["nan", "infinite", "beyond float16"],
)
def test_what_is_not_finite_is_refused_with_its_place(root, tmp_path, value, precision):
    sequence = rooms(root).source("train").read("c2")
    model = changed_where(small_autoreconstructor(), sequence.read(3).image / 255, value)
    with pytest.raises(DataError, match="its mean is not finite") as caught:
        encode(root, tmp_path / "cache", model, batch_size=4, precision=precision)
    assert (caught.value.sequence, caught.value.frame) == ("c2", sequence.frames[3])
    assert list((tmp_path / "cache").iterdir()) == []


def test_what_a_killed_run_leaves_does_not_open_and_is_written_over(root, cache, tmp_path):
    model, left, calls = small_autoreconstructor(), tmp_path / "left", []

    def copy(*_: object) -> None:
        # What lies on the disk when the last batch is encoded: all rows but its own.
        calls.append(shutil.copytree(tmp_path / "cache", left, dirs_exist_ok=True))

    model.encoder.register_forward_hook(copy)
    encode(root, tmp_path / "cache", model, batch_size=4)
    assert len(calls) > 3
    assert {path.name for path in left.iterdir()} == {"mean.npy", "log_variance.npy", "condition.npy"}
    with pytest.raises(DataError, match="no finished latent cache"):
        LatentCache(left)
    again = encode(root, left)
    assert again.manifest == cache.manifest
    assert all(np.array_equal(again.arrays[name], array) for name, array in cache.arrays.items())


def test_a_finished_store_is_kept(root, cache, caplog):
    before = {path: path.stat().st_mtime_ns for path in cache.folder.iterdir()}
    model = small_autoreconstructor()
    model.encoder.register_forward_hook(lambda *_: pytest.fail("encoded again"))
    with caplog.at_level(logging.INFO):
        assert encode(root, cache.folder, model).manifest == cache.manifest
    assert "already holds" in caplog.text
    assert {path: path.stat().st_mtime_ns for path in cache.folder.iterdir()} == before


def test_another_store_is_not_written_over(root, cache, tmp_path):
    other = sound_rooms(tmp_path / "other", clips=4)
    for options in ({"frames": 2}, {"precision": "float16"}, {"conditioning": Means()}):
        with pytest.raises(DataError, match="already holds another store"):
            encode(root, cache.folder, **options)
    for made in ((root, cache.folder, small_autoreconstructor(1)), (other, cache.folder)):
        with pytest.raises(DataError, match="already holds another store"):
            encode(*made)


def test_data_that_are_not_packed_are_refused(root, tmp_path):
    raw = rooms(root.with_name("raw"))
    with pytest.raises(DataError, match="run `completesplat data prepare` first"):
        encode_training_set(small_autoreconstructor(), raw, tmp_path / "cache", progress=False)
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("on_bad", ["skip", "raise"])
def test_damaged_data_are_refused_and_nothing_is_left(root, tmp_path, on_bad):
    store = Path(shutil.copytree(root, tmp_path / "store"))
    (shard,) = store.glob("train-*.arrow")
    content = shard.read_bytes()
    picture = content.index(b"BM", len(content) // 2)
    shard.write_bytes(content[: picture + 100] + bytes([content[picture + 100] ^ 1]) + content[picture + 101 :])
    with pytest.raises(DataError, match="is no longer what was written") as caught:
        encode_training_set(
            small_autoreconstructor(), rooms(store, on_bad=on_bad), tmp_path / "cache", batch_size=2, progress=False
        )
    assert caught.value.file == str(shard)
    assert list((tmp_path / "cache").iterdir()) == []


def test_too_little_space_is_noticed_before_anything_is_written(root, tmp_path, monkeypatch):
    usage = type("usage", (), {"free": 1000})
    monkeypatch.setattr(writing.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DataError, match=r"not enough space: about .* for 20 frames of 4 sequences"):
        encode(root, tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_the_estimate_is_the_size_of_the_rows(root, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        store = encode(root, tmp_path / "cache")
        few = encode(root, tmp_path / "few", frames=2)
    for made, frames in ((store, 20), (few, 8)):
        size = sum(array.nbytes for array in made.arrays.values())
        assert f"about {size / 1000:.1f} kB for {frames} frames" in caplog.text


@pytest.mark.parametrize("options", [{"precision": "float64"}, {"frames": 0}, {"batch_size": 0}])
def test_settings_without_a_meaning_are_refused(root, tmp_path, options):
    with pytest.raises(CompleteSplatError, match="needs precision=float32 or float16"):
        encode(root, tmp_path / "cache", **options)


def test_a_conditioning_that_is_trained_is_refused(root, tmp_path):
    trained = Means()
    trained.frozen = False
    with pytest.raises(CompleteSplatError, match="needs pictures"):
        encode(root, tmp_path / "cache", conditioning=trained)


def test_the_fingerprint_tells_names_types_shapes_and_values():
    def linear(**changes: object) -> nn.Module:
        torch.manual_seed(0)
        return nn.ModuleDict({"a": nn.Linear(2, 2)}).to(**changes)

    renamed = nn.ModuleDict({"b": linear()["a"]})
    nudged, reshaped = linear(), linear()
    nudged["a"].weight.data[1, 1] = torch.nextafter(nudged["a"].weight.data[1, 1], torch.tensor(9.0))
    reshaped["a"].weight = nn.Parameter(reshaped["a"].weight.data.view(4, 1))
    every = [linear(), renamed, nudged, reshaped, linear(dtype=torch.float64)]
    assert len({fingerprint(module) for module in every}) == len(every)
    assert fingerprint(linear()) == fingerprint(linear())
    assert fingerprint(small_autoreconstructor()) == fingerprint(
        small_autoreconstructor().to(memory_format=torch.channels_last)
    )


def test_the_cache_of_this_autoreconstructor_and_these_data_is_accepted(root, cache, tmp_path):
    learned = Means()
    learned.frozen = False
    source = rooms(root).source("train")
    check_cache(cache, small_autoreconstructor(), source)
    check_cache(cache, small_autoreconstructor(), source, learned)
    features = encode(root, tmp_path / "features", conditioning=Means())
    check_cache(features, small_autoreconstructor(), source, Means())
    # Only the encoder makes latents.
    other_head = small_autoreconstructor()
    nn.init.ones_(other_head.reconstructor.network.conv_out.weight)
    check_cache(cache, other_head, source)


def test_stale_caches_are_refused(root, cache, tmp_path):
    source = rooms(root).source("train")
    with pytest.raises(WeightsError, match="made with another autoreconstructor"):
        check_cache(cache, small_autoreconstructor(1), source)
    with pytest.raises(DataError, match="made from other data"):
        check_cache(cache, small_autoreconstructor(), rooms(sound_rooms(tmp_path / "other", clips=4)).source("train"))
    with pytest.raises(WeightsError, match="holds pictures"):
        check_cache(cache, small_autoreconstructor(), source, Means())
    features = encode(root, tmp_path / "features", conditioning=Means())
    with pytest.raises(WeightsError, match="features of another conditioning"):
        check_cache(features, small_autoreconstructor(), source, Means(2.0))


@pytest.mark.parametrize("change", ["channels", "size"])
def test_latents_of_another_shape_are_refused(root, cache, tmp_path, change):
    copy = Path(shutil.copytree(cache.folder, tmp_path / "copy"))
    content = json.loads((copy / "manifest.json").read_text())
    wide = small_autoreconstructor(latent_channels=3)
    if change == "channels":
        content["origin"]["encoder"] = fingerprint(wide.encoder)
    else:
        content["origin"]["image_size"] = 32
    (copy / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"latents of \(4, 2, 2\)"):
        check_cache(
            LatentCache(copy), wide if change == "channels" else small_autoreconstructor(), rooms(root).source("train")
        )


def test_a_manifest_is_read_as_it_was_written(cache):
    again = LatentCache(cache.folder).manifest
    assert again == cache.manifest
    assert again != replace(again, scale=2 * again.scale)
