"""Encoding a training set: what is stored, how latents are scaled, and which caches are refused."""

import itertools
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from latent_caches import FRAMES, rooms, small_autoreconstructor, sound_rooms
from torch import nn

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.loading.latent_cache import LatentCache, moments
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.training.encoding import (
    FrameEncoder,
    check_cache,
    encode_training_set,
    fingerprint,
    fingerprints,
    moment_sums,
)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return sound_rooms(tmp_path_factory.mktemp("root"))


def encode(root: Path, out: Path, model: nn.Module | None = None, **options) -> LatentCache:
    data = rooms(root, workers=options.pop("workers", 0))
    networks = ("conditioning", "precision", "device")
    encoder = FrameEncoder(model or small_autoreconstructor(), **{k: options.pop(k) for k in networks if k in options})
    return encode_training_set(encoder, data, out, **{"progress": False, **options})


@pytest.fixture(scope="module")
def cache(root, tmp_path_factory) -> LatentCache:
    return encode(root, tmp_path_factory.mktemp("cache"))


class Means(nn.Module):
    """A conditioning: the mean of each quarter of an image, times a weight."""

    def __init__(self, weight: float = 1.0, frozen: bool = True) -> None:
        super().__init__()
        self.frozen = frozen
        self.register_buffer("weight", torch.tensor(weight))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return nn.functional.avg_pool2d(images, 8) * self.weight


def test_every_frame_has_the_encoders_posterior(root, tmp_path):
    store = encode(root, tmp_path / "cache", batch_size=7, workers=2)
    encoder = small_autoreconstructor().encoder
    source = rooms(root).source("train")
    assert list(store.sequences) == source.names
    for name, frame in itertools.product(source.names, range(FRAMES)):
        image = source.read(name).read(frame).image
        with torch.no_grad():
            posterior, _ = encoder(image[None] / 255)
        scene = store.scene(name, frame)
        torch.testing.assert_close(scene.mean, posterior.mean[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(scene.log_variance, posterior.log_variance[0], rtol=1e-4, atol=1e-5)
        assert torch.equal((255 * scene.condition).round().to(torch.uint8), image)


def test_half_precision_needs_half_the_space_and_rounds_as_it_says(root, cache, tmp_path):
    half = encode(root, tmp_path / "half", precision="float16")
    for sequence, name in itertools.product(cache.sequences, ("mean", "log_variance")):
        exact = cache.arrays(sequence)[name]
        rounded = half.arrays(sequence)[name]
        assert 2 * rounded.nbytes == exact.nbytes
        assert (np.abs(rounded.astype(np.float64) - exact) <= 2.0**-11 * np.abs(exact) + 1e-7).all()
    assert half.std == pytest.approx(cache.std, rel=1e-3)


@pytest.mark.parametrize(("magnitude", "variance", "shift"), [(0.0, 4.0, 0.0), (3.0, 1e-3, 0.0), (0.5, 0.25, 7.0)])
def test_moments_are_those_of_a_mixture_of_two_equal_gaussians_in_each_channel(magnitude, variance, shift):
    """h = shift +- magnitude + sqrt(variance) * noise has variance magnitude^2 + variance."""
    sums = np.zeros((3, 2))
    signs = np.ones((10, 2, 3, 3), np.float32) * np.resize(np.float32([1, -1]), 10)[:, None, None, None]
    log_variance = np.full_like(signs, np.log(variance))
    for part in (slice(0, 3), slice(3, 10)):
        values = shift + magnitude * signs[part]
        values[:, 1] *= 2
        sums += moment_sums(values, log_variance[part])
    mean, std = moments(sums)
    assert mean == pytest.approx((shift, 2 * shift), abs=1e-6)
    assert std == pytest.approx([(factor * magnitude**2 + variance) ** 0.5 for factor in (1, 4)], rel=1e-5)


@pytest.mark.parametrize(("value", "precision"), [(float("nan"), "float32"), (1e30, "float16")])
def test_encodings_that_are_not_finite_are_refused_with_their_place(root, tmp_path, value, precision):
    sequence = rooms(root).source("train").read("c2")
    expected_image = sequence.read(3).image / 255
    model = small_autoreconstructor()

    def change(_: nn.Module, inputs: tuple, output: tuple) -> tuple:
        posterior, features = output
        hit = torch.tensor([torch.allclose(image, expected_image, atol=1e-6) for image in inputs[0]])
        factor = torch.where(hit, value, 1.0).view(-1, 1, 1, 1)
        return Posterior(posterior.mean * factor, posterior.log_variance), features

    model.encoder.register_forward_hook(change)
    with pytest.raises(DataError, match="its mean is not finite") as caught:
        encode(root, tmp_path / "cache", model, batch_size=4, precision=precision)
    assert (caught.value.sequence, caught.value.frame) == ("c2", sequence.frames[3])
    assert list((tmp_path / "cache").iterdir()) == []


def test_the_store_of_a_killed_run_does_not_open_and_is_overwritten(root, cache, tmp_path):
    model = small_autoreconstructor()
    left = tmp_path / "left"
    calls = []

    def copy(*_: object) -> None:
        # What lies on the disk when the last batch is encoded: all rows but its own.
        calls.append(shutil.copytree(tmp_path / "cache", left, dirs_exist_ok=True))

    model.encoder.register_forward_hook(copy)
    encode(root, tmp_path / "cache", model, batch_size=4)
    assert len(calls) > 3
    assert [path.name for path in left.iterdir()] == ["latents.arrow.unfinished"]
    with pytest.raises(DataError, match="no finished latent cache"):
        LatentCache(left)
    again = encode(root, left)
    assert again.manifest == cache.manifest
    assert (left / "latents.arrow").read_bytes() == (cache.folder / "latents.arrow").read_bytes()


def test_a_finished_store_is_kept_and_not_written_over(root, cache, tmp_path, caplog):
    before = {path: path.stat().st_mtime_ns for path in cache.folder.iterdir()}
    model = small_autoreconstructor()
    model.encoder.register_forward_hook(lambda *_: pytest.fail("encoded again"))
    with caplog.at_level(logging.INFO):
        assert encode(root, cache.folder, model).manifest == cache.manifest
    assert "already holds" in caplog.text
    other = sound_rooms(tmp_path / "other", clips=4)
    changes = [{"frames": 2}, {"precision": "float16"}, {"conditioning": Means()}]
    for changed in (*changes, {"model": small_autoreconstructor(1)}, {"root": other}):
        with pytest.raises(DataError, match="already holds another store"):
            encode(**{"root": root, "out": cache.folder} | changed)
    assert {path: path.stat().st_mtime_ns for path in cache.folder.iterdir()} == before


def test_settings_without_a_meaning_and_a_full_disk_are_refused(root, tmp_path, monkeypatch):
    for options, text in (
        ({"conditioning": Means(frozen=False)}, "needs images"),
        ({"root": root.with_name("raw")}, "run `completesplat data prepare` first"),
    ):
        with pytest.raises(CompleteSplatError, match=text):
            encode(**{"root": root, "out": tmp_path / "cache"} | options)
    assert not (tmp_path / "cache").exists()
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(DataError, match=r"not enough space: about .* for 20 frames of 4 sequences"):
        encode(root, tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_the_fingerprint_depends_on_names_types_shapes_and_values():
    weights = torch.rand(2, 2)
    nudged = weights.clone()
    nudged[1, 1] = torch.nextafter(nudged[1, 1], torch.tensor(9.0))
    every = [("a", weights), ("b", weights), ("a", nudged), ("a", weights.view(4, 1)), ("a", weights.double())]
    digests = [fingerprint(nn.ParameterDict({name: value})) for name, value in every]
    assert len(set(digests)) == len(every)
    assert digests[0] == fingerprint(nn.ParameterDict({"a": weights.T.contiguous().T}))  # of any memory layout


def test_latents_that_see_views_depend_on_the_weights_that_see_them():
    model = small_autoreconstructor()
    found = set()
    for view_encoder in (None, nn.Linear(2, 2), nn.Linear(2, 2)):
        model.view_encoder = view_encoder
        found.add(fingerprints(model, None)[0])
    assert len(found) == 3


def test_the_cache_of_this_model_is_accepted_and_stale_ones_are_refused(root, cache, tmp_path):
    own = small_autoreconstructor()
    other = small_autoreconstructor(1)
    features = encode(root, tmp_path / "features", conditioning=Means())
    nn.init.ones_(own.reconstructor.network.conv_out.weight)  # only the encoder makes latents
    check_cache(cache, own, Means(frozen=False))
    check_cache(features, own, Means())
    for store, model, conditioning, message in (
        (cache, other, Means(frozen=False), "made with another autoreconstructor"),
        (cache, own, Means(), "holds images"),
        (features, own, Means(2.0), "features of another conditioning"),
    ):
        with pytest.raises(WeightsError, match=message):
            check_cache(store, model, conditioning)
