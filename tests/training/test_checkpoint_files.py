import itertools
import os
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.demos.boring_classes import BoringModel
from scenes_for_training import quiet_trainer
from support import compose_config

from completesplat.training.checkpoints import CheckpointFiles


def test_a_file_is_written_whole_or_not_at_all_and_not_into_memory_first(tmp_path, monkeypatch):
    trainer = instantiate(compose_config("fit").trainer, accelerator="cpu", logger=False, _convert_="all")
    path = tmp_path / "last.ckpt"
    files = trainer.strategy.checkpoint_io
    (tmp_path / ".last.ckpt.unfinished").write_bytes(b"left by a run that was killed")
    files.save_checkpoint({"weights": torch.ones(3)}, path)

    def half(contents, file):
        Path(file).write_bytes(b"half")  # so it is no io.BytesIO
        raise OSError("no space left on device")

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(OSError, match="no space"):
        files.save_checkpoint({"weights": torch.zeros(3)}, path)
    assert torch.equal(torch.load(path, weights_only=True)["weights"], torch.ones(3))
    assert list(tmp_path.iterdir()) == [path]


def train(folder, steps, accumulated=1, **settings) -> None:
    """So many optimizer steps, with the configuration's callback."""
    config = compose_config("fit", f"out={folder}").callbacks.checkpoint
    callback = instantiate(config, every_n_train_steps=settings.pop("every_n_train_steps", None), **settings)
    surroundings = {"plugins": [CheckpointFiles()], "callbacks": [callback], "enable_checkpointing": True}
    trainer = quiet_trainer(max_steps=steps, accumulate_grad_batches=accumulated, **surroundings)
    trainer.fit(BoringModel(), torch.utils.data.DataLoader(torch.ones(100, 32)))


def step_of(path) -> int:
    return torch.load(path, weights_only=True)["global_step"]


@pytest.fixture
def written(monkeypatch) -> list[int]:
    """Sizes of the files that are written, in order."""
    sizes = []
    save = torch.save

    def recorded(contents, file):
        save(contents, file)
        sizes.append(Path(file).stat().st_size)

    monkeypatch.setattr(torch, "save", recorded)
    return sizes


def test_an_interval_writes_one_file(tmp_path, written):
    train(tmp_path, steps=5, every_n_train_steps=2)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.ckpt"]
    assert step_of(tmp_path / "checkpoints/last.ckpt") == 5
    assert len(written) == 3  # at 2, at 4 and in the end
    assert max(written) < 1.1 * min(written)


@pytest.mark.parametrize("links", [True, False])
def test_milestones_are_kept_and_written_once(tmp_path, written, monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError("not permitted")))
    train(tmp_path, steps=6, every_n_train_steps=2, keep_every=3)
    files = {path.name: path for path in (tmp_path / "checkpoints").iterdir()}
    assert {name: step_of(path) for name, path in files.items()} == {"last.ckpt": 6, "step=3.ckpt": 3, "step=6.ckpt": 6}
    assert len(written) == 4  # at 2, 3, 4, 6
    assert files["last.ckpt"].samefile(files["step=6.ckpt"]) == links


def test_intervals_in_minutes(tmp_path, written, monkeypatch):
    minutes = itertools.count()  # each look at the clock takes one: at the start, then after every step
    monkeypatch.setattr("completesplat.training.checkpoints.monotonic", lambda: 60.0 * next(minutes))
    train(tmp_path, steps=7, every_minutes=3)
    assert len(written) == 3  # after 3 steps, after 6, and in the end


def test_only_whole_optimizer_steps_are_written(tmp_path, monkeypatch):
    counts = []
    save = torch.save
    monkeypatch.setattr(torch, "save", lambda contents, file: counts.append(contents) or save(contents, file))
    train(tmp_path, steps=4, accumulated=3, every_minutes=0)
    batches = [c["loops"]["fit_loop"]["epoch_loop.batch_progress"]["total"]["completed"] for c in counts]
    assert [c["global_step"] for c in counts] == [1, 2, 3, 4]
    assert all(batch in (3 * n, 3 * n - 1) for n, batch in enumerate(batches, start=1))
