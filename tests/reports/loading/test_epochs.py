"""Rates of reading: what is counted, and what is timed."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from packed_sequences import ListedSource

from completesplat.benchmarks import data
from completesplat.benchmarks.data import Epoch, read_epoch, rows
from completesplat.data.loading.loader import EpochSampler, SceneLoader
from completesplat.data.loading.scenes import SceneStore, TrainingScenes
from completesplat.data.loading.view_selection import training_views


@pytest.fixture
def loader() -> SceneLoader:
    """Five scenes of three views, in batches of two."""
    source = ListedSource([f"sequence {number}" for number in range(5)])
    store = SceneStore(source, source.names)
    scenes = TrainingScenes(store, lambda n, rng: training_views(n, 2, rng), lambda scene, rng: scene, 1, 0)
    return SceneLoader(scenes, 2, EpochSampler(scenes.groups(), 0), 0)


def test_an_epoch_counts_batches_scenes_and_images(loader: SceneLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "time", SimpleNamespace(perf_counter=iter([3.0, 5.5]).__next__))
    assert read_epoch(loader, 0) == Epoch(2.5, batches=3, scenes=5, images=15)


def test_every_epoch_has_its_own_draws(loader: SceneLoader) -> None:
    assert loader.sampler is not None
    for number in (3, 7):
        read_epoch(loader, number)
        assert loader.sampler.epoch == number


def test_forms_take_turns_and_the_median_counts_without_the_first_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = {"a": iter([60.0, 10.0, 1.0, 20.0] * 2), "b": iter([90.0, 2.0, 2.5, 50.0] * 2)}
    read = []

    def read_from(name: str, number: int) -> Epoch:
        read.append((name, number))
        return Epoch(next(seconds[name[0]]), batches=3, scenes=5, images=15)

    def form(name: str) -> Callable[..., SimpleNamespace]:
        return lambda workers: SimpleNamespace(train_dataloader=lambda: f"{name}{workers}")

    monkeypatch.setattr(data, "read_epoch", read_from)
    said: list[str] = []
    found = rows({"a": form("a"), "b": form("b")}, [0, 2], 3, said.append)
    turns = [(form, 0, number) for number in range(4) for form in "ab"]
    turns += [(form, 2, number) for number in range(4) for form in "ab"]
    assert read == [(f"{form}{workers}", number) for form, workers, number in turns]
    assert len(said) == len(turns)
    assert [(row["form"], row["workers"], row["epoch_seconds"]) for row in found] == [
        (form, workers, {"a": 10.0, "b": 2.5}[form]) for workers in (0, 2) for form in "ab"
    ]
    slow, fast = found[:2]
    assert (slow["batches_per_second"], slow["scenes_per_second"], slow["images_per_second"]) == (0.3, 0.5, 1.5)
    assert (slow["times_first"], fast["times_first"]) == (1.0, 4.0)
