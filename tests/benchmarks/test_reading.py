"""Epochs are counted and timed, memory is that of the process, and functions are watched without being changed."""

import json
import mmap
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from packed_sequences import ListedSource

from completesplat.benchmarks import reading
from completesplat.benchmarks.data_loading import RepeatedSource
from completesplat.benchmarks.reading import (
    Counter,
    Epoch,
    Stopwatch,
    decoding_share,
    read_epoch,
    replaced,
    resident_megabytes,
    rows,
)
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.loading.loader import EpochSampler, SceneLoader
from completesplat.data.loading.scenes import SceneStore, TrainingScenes
from completesplat.data.loading.view_selection import training_views
from completesplat.data.sequences import SequenceSource


@pytest.fixture
def loader() -> SceneLoader:
    """Five scenes of three views, in batches of two."""
    source = ListedSource([f"sequence {number}" for number in range(5)])
    store = SceneStore(source, source.names)
    scenes = TrainingScenes(store, lambda n, _, rng: training_views(n, 2, rng), lambda scene, rng: scene, 1, 0)
    return SceneLoader(scenes, 2, EpochSampler(scenes.groups(), 0), 0)


def test_an_epoch_counts_batches_scenes_and_images(loader: SceneLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "time", SimpleNamespace(perf_counter=iter([3.0, 5.5]).__next__))
    assert read_epoch(loader, 7) == Epoch(2.5, batches=3, scenes=5, images=15)
    assert loader.sampler.epoch == 7  # every epoch has its own draws


def test_forms_take_turns_and_the_median_counts_without_the_first_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = {"a": iter([60.0, 10.0, 1.0, 20.0] * 2), "b": iter([90.0, 2.0, 2.5, 50.0] * 2)}
    read = []

    def read_from(name: str, number: int) -> Epoch:
        read.append((name, number))
        return Epoch(next(seconds[name[0]]), batches=3, scenes=5, images=15)

    def form(name: str) -> Callable[..., SimpleNamespace]:
        return lambda workers: SimpleNamespace(train_dataloader=lambda: f"{name}{workers}")

    monkeypatch.setattr(reading, "read_epoch", read_from)
    said: list[str] = []
    found = rows({"a": form("a"), "b": form("b")}, [0, 2], 3, said.append)
    assert read == [(f"{form}{workers}", number) for workers in (0, 2) for number in range(4) for form in "ab"]
    assert len(said) == len(read)
    keys = [(row["form"], row["workers"], row["epoch_seconds"]) for row in found]
    assert keys == [(form, workers, taken) for workers in (0, 2) for form, taken in (("a", 10.0), ("b", 2.5))]
    slow, fast = found[:2]
    assert (slow["batches_per_second"], slow["scenes_per_second"], slow["images_per_second"]) == (0.3, 0.5, 1.5)
    assert (slow["times_first"], fast["times_first"]) == (1.0, 4.0)


def test_sequences_come_again_under_other_names() -> None:
    few = ListedSource(["a", "b", "c"])
    many = RepeatedSource(few, 7)
    assert isinstance(many, SequenceSource)
    assert len(set(many.names)) == 7
    for name, original in zip(many.names, "abcabca", strict=True):
        found, expected = many.read(name), few.read(original)
        assert (found.name, found.frames) == (name, expected.frames)
        assert torch.equal(found.cameras.world_to_camera, expected.cameras.world_to_camera)
        assert torch.equal(found.read(1).image, expected.read(1).image)
    assert sorted(number for group in many.groups(many.names) for number in group) == list(range(7))


def test_memory_of_the_process_and_pages_of_a_mapped_file_are_counted_apart(tmp_path: Path, monkeypatch) -> None:
    np.save(tmp_path / "array.npy", np.ones(60 * 2**20, np.uint8))
    before = resident_megabytes()
    # Fresh pages from the system: an allocator may give out memory that the process has already.
    kept = np.frombuffer(mmap.mmap(-1, 60 * 2**20, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.uint8)
    kept[:] = 1
    between = resident_megabytes()
    mapped = np.load(tmp_path / "array.npy", mmap_mode="r")
    assert all(mapped[::4096])
    after = resident_megabytes()
    assert all((before, between, after))
    assert 55 < between["anonymous"] - before["anonymous"] < 70
    assert 55 < after["file"] - between["file"] < 70
    assert after["anonymous"] - between["anonymous"] < 20
    assert kept.all()
    monkeypatch.setattr(reading, "STATUS", tmp_path / "none")
    assert resident_megabytes() is None


def test_a_stopwatch_adds_up_what_the_functions_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a function is put back also after an error."""
    original = json.loads
    monkeypatch.setattr(reading, "time", SimpleNamespace(perf_counter=iter([1.0, 3.0, 10.0, 10.5]).__next__))
    watch = Stopwatch()
    with replaced("json.loads", watch.wrap):
        assert json.loads("[1]") == [1]
    with pytest.raises(ValueError, match="Expecting value"), replaced("json.loads", watch.wrap):
        json.loads("")
    assert watch.seconds == 2.5
    assert json.loads is original


def test_what_is_held_counts_with_the_one_that_is_being_made() -> None:
    counter = Counter()
    read = counter.wrap(lambda number: {"number": number})
    held = [read(0), read(1)]
    del held[0]
    held += [read(2), read(3)]
    assert (counter.calls, counter.most) == (4, 3)


def test_decoding_is_part_of_reading(toy_root) -> None:
    data = CO3DDataModule(str(toy_root), "toy_objects", "fewview_train", image_size=16, batch_size=2)
    assert 0 < decoding_share(data.train_dataloader()) < 1
