"""A checkpoint is there as a whole or not at all."""

import io

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config

from completesplat.training.checkpoint_files import CheckpointFiles


def test_a_checkpoint_that_cannot_be_written_leaves_the_last_one(tmp_path, monkeypatch):
    path, files = tmp_path / "run/last.ckpt", CheckpointFiles()
    files.save_checkpoint({"weights": torch.ones(3)}, path)

    def half(contents, file):
        with open(file, "wb") as stream:
            stream.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(OSError, match="no space"):
        files.save_checkpoint({"weights": torch.zeros(3)}, path)
    assert torch.equal(torch.load(path, weights_only=True)["weights"], torch.ones(3))
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_what_a_killed_run_left_unfinished_is_replaced(tmp_path):
    (tmp_path / ".last.ckpt.unfinished").write_bytes(b"half")
    CheckpointFiles().save_checkpoint({"weights": torch.ones(3)}, tmp_path / "last.ckpt")
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]


def test_training_writes_its_checkpoints_so_and_not_into_memory_first(tmp_path, monkeypatch):
    trainer = instantiate(compose_config("fit").trainer, accelerator="cpu", logger=False, _convert_="all")
    assert isinstance(trainer.strategy.checkpoint_io, CheckpointFiles)
    saved = []
    monkeypatch.setattr(torch, "save", lambda contents, file: saved.append(file) or open(file, "wb").close())
    trainer.strategy.checkpoint_io.save_checkpoint({}, tmp_path / "last.ckpt")
    assert not any(isinstance(file, io.BytesIO) for file in saved)
    assert (tmp_path / "last.ckpt").is_file()
