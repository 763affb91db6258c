import multiprocessing
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from realestate10k_trees import FORMS, epoch, equal, make_clip, module, same, write_tree

from completesplat.data.loading.loader import EpochSampler, SceneLoader
from completesplat.scene import SceneBatch

AUGMENTED = {
    "color_jitter": {"brightness": 0.2, "contrast": 0.2, "saturation": 0.2, "hue": 0.1},
    "box_masks": {"probability": 0.7},
    "horizontal_flip": True,
}


@pytest.fixture(scope="module", params=FORMS)
def root(request, tmp_path_factory) -> Path:
    """Nine clips, one of which has an image that cannot be read."""
    clips = [make_clip(f"c{i}", frames=3) for i in range(9)]
    clips[5].images[1] = b"<html>"
    return write_tree(tmp_path_factory.mktemp("root"), request.param, clips, clips[:2])


def loader(root: Path, workers: int = 0, **settings) -> SceneLoader:
    """Eight items an epoch in batches of three."""
    settings = {"batch_size": 3, "val_fraction": 0.0, "max_bad_fraction": 10.0, **AUGMENTED, **settings}
    return module(root, workers=workers, **settings).train_dataloader()


@pytest.fixture(scope="module")
def epochs(root) -> list[list[SceneBatch]]:
    """The expected batches of two epochs."""
    expected = loader(root)
    batches = [epoch(expected, 0), epoch(expected, 1)]
    assert [len(part) for part in batches] == [3, 3]
    assert not equal(*batches)
    return batches


@pytest.mark.processes
def test_workers_do_not_change_the_batches_nor_what_is_skipped(root, epochs):
    one, other = loader(root), loader(root, workers=2)
    for number, expected in enumerate(epochs):
        assert equal(epoch(other, number), expected)
        epoch(one, number)
        assert [str(error) for error in other.refused] == [str(error) for error in one.refused]
        assert one.refused


def test_by_default_there_are_no_more_workers_than_cores(tmp_path, monkeypatch):
    for cores, expected in ((2, 2), (64, 4), (None, 1)):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        assert module(tmp_path, workers=None).workers == expected


def test_an_item_is_drawn_from_seed_epoch_and_index_alone(root):
    items = loader(root).dataset
    later = [items[1, 5].scenes, items[0, 2].scenes]
    torch.manual_seed(7)
    again = loader(root).dataset
    assert same(again[0, 2].scenes, later[1])
    assert same(again[1, 5].scenes, later[0])
    assert not same(again[2, 5].scenes, later[0])
    assert not same(loader(root, seed=1).dataset[1, 5].scenes, later[0])


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.processes)])
def test_a_resumed_iteration_continues_exactly(root, epochs, workers):
    for done in (0, 2, 3) if workers == 0 else (1,):
        interrupted = loader(root, workers)
        interrupted.sampler.set_epoch(1)
        batches: Iterator[SceneBatch] = iter(interrupted)
        assert equal([next(batches) for _ in range(done)], epochs[1][:done])
        state = interrupted.state_dict()
        resumed = loader(root, workers)
        resumed.load_state_dict(state)
        # Before its first batch an iteration has no epoch of its own.
        assert equal(epoch(resumed, 1), epochs[1][done:])
        assert equal(epoch(resumed, 1), epochs[1])


def test_neither_the_state_of_another_epoch_nor_an_abandoned_iteration_changes_the_next(root, epochs):
    resumed, abandoned = loader(root), loader(root)
    resumed.load_state_dict({"epoch": 0, "batches": 2})
    assert same(next(iter(abandoned)), epochs[0][0])
    for other in (resumed, abandoned):
        assert equal(epoch(other, 1), epochs[1])
        assert other.state_dict() == {"epoch": 1, "batches": 3}


@pytest.mark.parametrize("world_size", [2, 3])
def test_processes_have_their_own_items_and_equally_many(root, monkeypatch, world_size):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: world_size)
    groups, parts = [[0, 1, 2, 3], [4, 5], [6]], []
    for rank in range(world_size):
        monkeypatch.setattr(torch.distributed, "get_rank", lambda rank=rank: rank)
        sampler = EpochSampler(groups, 0)
        sampler.set_epoch(2)
        parts.append(list(sampler))
        assert len(sampler) == len(parts[-1]) == 7 // world_size
        assert len(loader(root, batch_size=3 * world_size)) == -(-(8 // world_size) // 3)
    keys = [key for part in parts for key in part]
    assert len(set(keys)) == len(keys) == 7 // world_size * world_size
    assert set(keys) <= {(2, index) for index in range(7)}


class Recorder(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[tuple] = []

    def training_step(self, batch, index):
        self.seen.append((self.current_epoch, index, batch.names, batch.all_views().images.double().sum().item()))
        return self.weight**2

    def validation_step(self, batch, index): ...  # So that epochs are interrupted by validation.

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Eight training clips: four batches an epoch."""
    made = [make_clip(f"c{i}", frames=3) for i in range(9)]
    return write_tree(tmp_path_factory.mktemp("clips"), "text", made, made[:2])


def train(root: Path, out: Path, steps: int, workers: int, resume: Path | None = None, **options) -> list[tuple]:
    recorder = Recorder()
    checkpoint = ModelCheckpoint(out, filename="{step}", every_n_train_steps=1, save_top_k=-1)
    trainer = Trainer(
        max_steps=steps, accelerator="cpu", logger=False, callbacks=[checkpoint], enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, **options,
    )  # fmt: skip
    data = module(root, workers=workers, val_fraction=0.0)
    trainer.fit(recorder, data, ckpt_path=resume, weights_only=False)
    return recorder.seen


@pytest.mark.parametrize(
    ("workers", "options"),
    [
        (0, {"limit_train_batches": 3}),
        (0, {"val_check_interval": 2}),
        pytest.param(2, {}, marks=pytest.mark.processes),
    ],
)
def test_a_resumed_run_sees_the_rest_and_worker_processes_end_with_it(clips, tmp_path, workers, options):
    before = set(multiprocessing.active_children())
    whole = train(clips, tmp_path / "whole", 7, workers, **options)
    assert set(multiprocessing.active_children()) <= before
    per_epoch = options.get("limit_train_batches", 4)
    assert [epoch for epoch, *_ in whole] == [step // per_epoch for step in range(7)]
    first, second = ([seen[2:] for seen in whole[start : start + 3]] for start in (0, per_epoch))
    assert first != second
    # In an epoch, at its end, and where validation interrupts the second.
    for done in (1, 4) if workers else (1, 3, 6):
        resumed = train(clips, tmp_path / f"{done}", 7, workers, tmp_path / f"whole/step={done}.ckpt", **options)
        assert resumed == whole[done:]
