import logging
from pathlib import Path

import pytest
from lightning import LightningModule, Trainer
from realestate10k_trees import assert_refusal, epoch, make_clip, module, write_tree

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.validation import BadCamera, BadImage
from completesplat.errors import CompleteSplatError, DataError
from completesplat.settings.schema import check_value, hints_of

KEYS = [f"c{i}" for i in range(9)]


def make_tree(root: Path, broken_images: list[str], cameras: list[str] = ()) -> Path:
    """Clips of which some have broken images, others broken cameras."""
    clips = {key: make_clip(key, frames=3) for key in KEYS}
    for key in broken_images:
        clips[key].images[1:] = [b"<html>", b"<html>"]
    for key in cameras:
        clips[key].rows[1, 0] = 0
    clips = list(clips.values())
    return write_tree(root, "text", clips, clips)


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.processes)])
def test_a_refusal_reaches_the_main_process_with_its_place(tmp_path, workers):
    root = make_tree(tmp_path, ["c5"], ["c2"])
    data = module(root, on_bad="raise", workers=workers, evaluation_batch_size=1)
    with pytest.raises(DataError) as caught:
        list(data.test_dataloader())
    assert_refusal(caught.value, BadCamera, root / "test/c2.txt", "c2", 1)
    with pytest.raises(DataError) as caught:
        list(data.train_dataloader())
    assert caught.value.sequence in ("c2", "c5")


def test_an_epoch_tells_what_it_skipped_by_kind_and_counts_anew(tmp_path, caplog):
    data = module(make_tree(tmp_path, ["c5"], ["c2"]), val_fraction=0.0, max_bad_fraction=1.0)
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
    data = module(make_tree(tmp_path, ["c5"], ["c2"]), max_bad_fraction=0.5, evaluation_batch_size=2)
    loader = data.test_dataloader()
    assert [name for batch in loader for name in batch.names] == [key for key in KEYS if key not in ("c2", "c5")]
    assert [error.sequence for error in loader.refused] == ["c2", "c5"]
    assert [r.getMessage()[:20] for r in caplog.records if r.levelno >= logging.WARNING] == ["skipped 2 of 9 items"]


def test_too_many_are_an_error_that_names_the_share_and_the_last(tmp_path):
    root = make_tree(tmp_path, ["c5"], ["c2", "c6"])
    with pytest.raises(DataError, match=r"3 of 9 items .* data\.max_bad_fraction=0\.25 .*last one: .*c6, frame 1"):
        list(module(root, max_bad_fraction=0.25).test_dataloader())
    with pytest.raises(DataError, match=r"data\.max_bad_fraction=0\.1"):
        list(module(root, max_bad_fraction=0.1, val_fraction=0.0).train_dataloader())
    assert len(list(module(root, max_bad_fraction=0.34, evaluation_batch_size=1).test_dataloader())) == 6
    one_bad = module(make_tree(tmp_path / "one", ["c5"]), max_bad_fraction=0.0, evaluation_batch_size=1)
    assert len(list(one_bad.test_dataloader())) == 8  # One is no share.


def test_nothing_that_can_be_read_and_an_unknown_policy_are_errors(tmp_path):
    data = module(make_tree(tmp_path, KEYS), max_bad_fraction=2.0)
    for loader in (data.train_dataloader(), data.test_dataloader()):
        with pytest.raises(DataError, match="items cannot be read"):
            list(loader)
    with pytest.raises(CompleteSplatError, match=r"data\.on_bad=ignore: choose one of skip, raise"):
        check_value("data.on_bad", hints_of(SceneDataModule.__init__)["on_bad"], "ignore")


class Listener(LightningModule):
    """Trains nothing."""

    def training_step(self, batch, index):
        return None

    def configure_optimizers(self):
        return None


@pytest.mark.parametrize("limit", [1.0, 3])
def test_lightning_hears_it_at_the_end_of_each_epoch(tmp_path, caplog, limit):
    data = module(make_tree(tmp_path, [], ["c1", "c2", "c5"]), val_fraction=0.0, max_bad_fraction=10.0, batch_size=2)
    trainer = Trainer(
        max_epochs=2, limit_train_batches=limit, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    with caplog.at_level(logging.WARNING, logger="completesplat"):
        trainer.fit(Listener(), data.train_dataloader())
    messages = [record.getMessage() for record in caplog.records if record.name == "completesplat.data.loading.loader"]
    assert [message[:7] for message in messages] == ["skipped", "skipped"]
