"""A run of Lightning that is stopped and resumed sees what an uninterrupted one sees."""

import multiprocessing
from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from realestate10k_trees import make_clip, module, write_tree


class Recorder(LightningModule):
    """Writes down each batch: its names and the sum of its pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[tuple] = []

    def training_step(self, batch, index):
        self.seen.append((self.current_epoch, index, batch.names, batch.all_views().images.double().sum().item()))
        return self.weight**2

    def validation_step(self, batch, index):
        """So that epochs are interrupted by validation."""

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Eight training clips: four batches an epoch."""
    clips = [make_clip(f"c{i}", frames=3) for i in range(9)]
    return write_tree(tmp_path_factory.mktemp("root"), "text", clips, clips[:2])


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
    ("workers", "options"), [(0, {}), (2, {}), (0, {"limit_train_batches": 3}), (0, {"val_check_interval": 2})]
)
def test_a_resumed_run_sees_the_rest(root, tmp_path, workers, options):
    """Stopped in the middle of an epoch, before its last batch and at its end."""
    whole = train(root, tmp_path / "whole", 10, workers, **options)
    per_epoch = options.get("limit_train_batches", 4)
    assert [epoch for epoch, *_ in whole] == [step // per_epoch for step in range(10)]
    assert len(set(whole)) == 10
    for done in (1, 3, 4, 6) if workers == 0 else (1, 4):
        resumed = train(root, tmp_path / f"{done}", 10, workers, tmp_path / f"whole/step={done}.ckpt", **options)
        assert resumed == whole[done:]


def test_worker_processes_end_with_the_run(root, tmp_path):
    before = set(multiprocessing.active_children())
    train(root, tmp_path, 3, workers=2)
    assert set(multiprocessing.active_children()) <= before
