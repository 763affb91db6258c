import logging
import multiprocessing
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from realestate10k_trees import epoch, equal, make_clip, module, same, write_tree

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.data_set import SceneDataSet
from completesplat.data.loading.loader import EpochSampler, SceneLoader
from completesplat.errors import BadCamera, BadImage, CompleteSplatError, DataError
from completesplat.scene import SceneBatch
from completesplat.settings.schema import check_value, hints_of

KEYS = [f"c{i}" for i in range(9)]
AUGMENTED = {
    "color_jitter": {"brightness": 0.2, "contrast": 0.2, "saturation": 0.2, "hue": 0.1},
    "box_masks": {"probability": 0.7},
    "horizontal_flip": True,
}


def make_tree(root: Path, broken: str = "", half_broken: str = "", cameras: str = "", form: str = "text") -> Path:
    """Nine clips, of which some have one readable image, others two of three, others broken cameras."""
    clips = {key: make_clip(key, frames=3) for key in KEYS}
    for key in broken.split():
        clips[key].images[1:] = [b"<html>", b"<html>"]
    for key in half_broken.split():
        clips[key].images[1] = b"<html>"
    for key in cameras.split():
        clips[key].rows[1, 0] = 0
    return write_tree(root, form, [*clips.values()], [*clips.values()])


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Chunks of two clips, which are read together; one clip has an image that cannot be read."""
    return make_tree(tmp_path_factory.mktemp("root"), half_broken="c5", form="chunks")


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


def test_by_default_there_are_no_more_workers_than_usable_cores(tmp_path, monkeypatch):
    for usable, cores, expected in (({0, 5}, 64, 2), (set(range(64)), 128, 4), (None, 2, 2), (None, None, 1)):
        if usable is None:  # as on Macs and Windows
            monkeypatch.delattr("os.sched_getaffinity", raising=False)
        else:
            monkeypatch.setattr("os.sched_getaffinity", lambda _, usable=usable: usable, raising=False)
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


QUIET = dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary"), False) | {"accelerator": "cpu"}


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Eight training clips: four batches an epoch."""
    return make_tree(tmp_path_factory.mktemp("clips"))


def train(root: Path, out: Path, steps: int, workers: int, resume: Path | None = None, **options) -> list[tuple]:
    recorder = Recorder()
    checkpoint = ModelCheckpoint(out, filename="{step}", every_n_train_steps=1, save_top_k=-1)
    trainer = Trainer(max_steps=steps, callbacks=[checkpoint], num_sanity_val_steps=0, **QUIET, **options)
    trainer.fit(recorder, module(root, workers=workers, val_fraction=0.0), ckpt_path=resume, weights_only=False)
    return recorder.seen


@pytest.mark.parametrize(
    ("workers", "options"),
    [(0, {"limit_train_batches": 3}), (0, {"val_check_interval": 2}), pytest.param(2, {}, marks=pytest.mark.processes)],
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


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.processes)])
def test_a_refusal_reaches_the_main_process_with_its_place(tmp_path, workers):
    root = make_tree(tmp_path, "c5", cameras="c2")
    data = module(root, on_bad="raise", workers=workers, evaluation_batch_size=1)
    with pytest.raises(BadCamera, match=rf"^{root}/test/c2\.txt, c2, frame 1: "):
        list(data.test_dataloader())
    with pytest.raises(DataError) as caught:
        list(data.train_dataloader())
    assert caught.value.sequence in ("c2", "c5")


def test_an_epoch_tells_what_it_skipped_by_kind_and_counts_anew(tmp_path, caplog):
    data = module(make_tree(tmp_path, "c5", cameras="c2"), val_fraction=0.0, max_bad_fraction=1.0)
    loader = data.train_dataloader()
    for number in (0, 1):
        caplog.clear()
        epoch(loader, number)
        kinds = [type(error) for error in loader.refused]
        assert kinds.count(BadImage) >= 1 <= kinds.count(BadCamera)
        (message,) = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
        assert message.startswith(f"skipped {len(kinds)} of 8 items (")
        assert f"{kinds.count(BadImage)} {BadImage.kind}" in message
        assert f"{kinds.count(BadCamera)} {BadCamera.kind}" in message
        assert message.endswith(f"the first: {loader.refused[0]}")


def test_evaluation_drops_what_cannot_be_read_and_says_so(tmp_path, caplog):
    data = module(make_tree(tmp_path, "c5", cameras="c2"), max_bad_fraction=0.5, evaluation_batch_size=2)
    loader = data.test_dataloader()
    assert [name for batch in loader for name in batch.names] == [key for key in KEYS if key not in ("c2", "c5")]
    assert [error.sequence for error in loader.refused] == ["c2", "c5"]
    assert [r.getMessage()[:20] for r in caplog.records if r.levelno >= logging.WARNING] == ["skipped 2 of 9 items"]


def test_too_many_are_an_error_that_names_the_share_and_the_last(tmp_path):
    root = make_tree(tmp_path, "c5", cameras="c2 c6")
    with pytest.raises(DataError, match=r"3 of 9 items .* data\.max_bad_fraction=0\.25 .*last one: .*c6, frame 1"):
        list(module(root, max_bad_fraction=0.25).test_dataloader())
    with pytest.raises(DataError, match=r"data\.max_bad_fraction=0\.1"):
        list(module(root, max_bad_fraction=0.1, val_fraction=0.0).train_dataloader())
    assert len(list(module(root, max_bad_fraction=0.34, evaluation_batch_size=1).test_dataloader())) == 6
    one_bad = make_tree(tmp_path / "one", "c5")
    assert len(list(module(one_bad, max_bad_fraction=0.01, evaluation_batch_size=1).test_dataloader())) == 8
    with pytest.raises(DataError, match=r"1 of 9 items .* data\.max_bad_fraction=0 allows"):
        list(module(one_bad, max_bad_fraction=0.0).test_dataloader())


def test_nothing_that_can_be_read_and_settings_that_make_no_sense_are_errors(tmp_path):
    data = module(make_tree(tmp_path, " ".join(KEYS)), max_bad_fraction=2.0)
    for loader in (data.train_dataloader(), data.test_dataloader()):
        with pytest.raises(DataError, match="items cannot be read"):
            list(loader)
    with pytest.raises(CompleteSplatError, match=r"data\.on_bad=ignore: choose one of skip, raise"):
        check_value("data.on_bad", hints_of(SceneDataSet.__init__)["on_bad"], "ignore")
    with pytest.raises(CompleteSplatError, match=r"data\.targets=-1: must be at least 0"):
        check_value("data.targets", hints_of(SceneDataModule.__init__)["targets"], -1)


@pytest.mark.parametrize("limit", [1.0, 3])
def test_lightning_hears_it_at_the_end_of_each_epoch(tmp_path, caplog, limit):
    data = module(make_tree(tmp_path, cameras="c1 c2 c5"), val_fraction=0.0, max_bad_fraction=10.0, batch_size=2)
    trainer = Trainer(max_epochs=2, limit_train_batches=limit, enable_checkpointing=False, **QUIET)
    with caplog.at_level(logging.WARNING, logger="completesplat"):
        trainer.fit(Recorder(), data.train_dataloader())
    messages = [record.getMessage() for record in caplog.records if record.name == "completesplat.data.loading.loader"]
    assert [message[:7] for message in messages] == ["skipped", "skipped"]
