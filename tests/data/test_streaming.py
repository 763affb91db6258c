"""Training from a stream: what is in an epoch, who reads what, and going on after an interruption."""

from collections import Counter
from pathlib import Path

import pytest
import torch

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.loading.scenes import TrainingScenes
from completesplat.data.packed.writing import prepare
from completesplat.data.toy import write_objects
from completesplat.data.toy.objects import SUBSET
from completesplat.errors import CompleteSplatError, DataError
from completesplat.scene import SceneBatch

SPLITS = ("train", "val", "test")


def module(root: Path, **settings) -> CO3DDataModule:
    defaults = {"image_size": 8, "batch_size": 2, "targets": 1, "references_per_sequence": 2, "streaming": True}
    return CO3DDataModule(str(root), "toy_objects", SUBSET, **defaults | settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prepared set with 8 training sequences in 4 shards."""
    folder = tmp_path_factory.mktemp("streamed")
    write_objects(folder / "raw", scenes=10, frames=3, size=8, seed=0, workers=1, progress=False)
    raw = module(folder / "raw")
    sources = {split: raw.source(split) for split in SPLITS}
    return prepare(sources, raw.prepared_settings(), folder / "store", sequences_per_shard=2, workers=1, progress=False)


def epoch(data: CO3DDataModule, number: int, resumed_after: int | None = None) -> list[SceneBatch]:
    loader = data.train_dataloader()
    loader.sampler.set_epoch(number)
    if resumed_after is not None:
        loader.load_state_dict({"epoch": number, "batches": resumed_after})
    return list(loader)


def names(batches: list[SceneBatch]) -> list[str]:
    return [name for batch in batches for name in batch.names]


def equal(one: list[SceneBatch], other: list[SceneBatch]) -> bool:
    return len(one) == len(other) and all(
        a.names == b.names and torch.equal(a.all_views().images, b.all_views().images)
        for a, b in zip(one, other, strict=True)
    )


def test_an_epoch_has_every_sequence_as_often_as_it_has_references(store):
    batches = epoch(module(store), 0)
    assert len(batches) == len(module(store).train_dataloader()) == 8
    assert Counter(names(batches)) == dict.fromkeys(module(store).source("train").names, 2)


def test_scenes_are_those_of_the_same_items_read_in_another_order(store):
    def contents(batches: list[SceneBatch]) -> set[tuple[str, bytes]]:
        images = [image for batch in batches for image in batch.all_views().images]
        return {(name, image.numpy().tobytes()) for name, image in zip(names(batches), images, strict=True)}

    streamed, read = epoch(module(store), 3), epoch(module(store, streaming=False), 3)
    assert contents(streamed) == contents(read)
    assert names(streamed) != names(read)


def test_epochs_differ_in_their_order_and_can_be_repeated(store):
    assert names(epoch(module(store), 0)) != names(epoch(module(store), 1))
    assert equal(epoch(module(store), 1), epoch(module(store), 1))


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("done", [1, 4, 7])
def test_a_resumed_epoch_goes_on_exactly(store, workers, done):
    whole = epoch(module(store, workers=workers), 2)
    assert equal(epoch(module(store, workers=workers), 2, resumed_after=done), whole[done:])


def test_training_processes_read_disjoint_parts(store, monkeypatch):
    def of_process(rank: int) -> list[SceneBatch]:
        monkeypatch.setattr("completesplat.data.loading.streaming.processes", lambda: (rank, 2))
        return epoch(module(store, references_per_sequence=1), 0)

    first, second = names(of_process(0)), names(of_process(1))
    assert len(first) == len(second) == 4
    assert {*first, *second} == set(module(store).source("train").names)


def test_workers_read_disjoint_parts(store):
    seen = names(epoch(module(store, references_per_sequence=1, workers=2), 0))
    assert sorted(seen) == sorted(module(store).source("train").names)


def test_more_workers_than_shards_are_of_no_use_and_do_no_harm(store):
    seen = names(epoch(module(store, workers=5), 0))
    assert Counter(seen) == dict.fromkeys(module(store).source("train").names, 2)


def test_what_cannot_be_read_is_counted_and_left_out(store, monkeypatch):
    bad = module(store).source("train").names[0]
    make = TrainingScenes.make

    def make_or_refuse(scenes, sequence, rng):
        if sequence.name == bad:
            raise DataError("broken", sequence=bad)
        return make(scenes, sequence, rng)

    monkeypatch.setattr(TrainingScenes, "make", make_or_refuse)
    loader = module(store, most_bad=0.5).train_dataloader()
    seen = names(list(loader))
    assert len(seen) == 16
    assert bad not in seen
    assert {error.sequence for error in loader.refused} == {bad}
    with pytest.raises(DataError, match="broken"):
        list(module(store, on_bad="raise").train_dataloader())


def test_more_processes_than_sequences_are_refused(store, monkeypatch):
    monkeypatch.setattr("completesplat.data.loading.streaming.processes", lambda: (9, 10))
    with pytest.raises(DataError, match="no sequences"):
        list(module(store, references_per_sequence=20).train_dataloader())


def test_data_that_are_not_prepared_are_not_streamed(store):
    with pytest.raises(CompleteSplatError, match="prepared"):
        module(store.parent / "raw").train_dataloader()
