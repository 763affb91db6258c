"""What tests of training need that a model of one layer can show."""

import csv
from pathlib import Path

import torch
from lightning.pytorch.demos.boring_classes import BoringModel
from scenes_for_training import quiet_trainer

from completesplat.training.checkpoints import LAST, CheckpointFiles, Checkpoints
from completesplat.training.loggers import ContinuedCSVLogger

STEPS = 15  # an epoch of `Batches` has twelve


class Batches:
    """Twelve batches of one vector each, of which a continued run takes the rest."""

    def __init__(self) -> None:
        self.given = self.start = 0

    def __len__(self) -> int:
        return 12

    def __iter__(self):
        first, self.start = self.start, 0
        for self.given in range(first + 1, 13):
            yield torch.randn(1, 32, generator=torch.Generator().manual_seed(self.given))

    def state_dict(self):
        return {"given": self.given % 12}

    def load_state_dict(self, state):
        self.start = state["given"]


class Logging(BoringModel):
    """Rows of every second step, of validation at every third, and of some steps by itself."""

    def training_step(self, batch, index):
        loss = self.layer(batch).square().mean()
        self.log("train/loss", loss.detach())
        if self.global_step % 4 == 1:
            self.logger.log_metrics({"own": loss.item()}, step=self.global_step)
        return loss

    def validation_step(self, batch, index):
        self.log("val/loss", self.layer(batch).square().mean())


def fit(
    folder: Path,
    steps: int = STEPS,
    every: int = 1,
    model: type[Logging] = Logging,
    keep_every: int = 5,
    start: Path | None = None,
    **settings: object,
) -> None:
    """Go on in a folder, as `completesplat fit ckpt_path=last` does, and write the final row."""
    torch.manual_seed(0)
    module, logger = model(), ContinuedCSVLogger(str(folder))
    checkpoints = Checkpoints(str(folder / "checkpoints"), every_n_train_steps=every, keep_every=keep_every * every)
    settings |= {"logger": logger, "plugins": [CheckpointFiles()], "callbacks": [checkpoints]}
    settings |= {"enable_checkpointing": True, "num_sanity_val_steps": 0, "log_every_n_steps": 2}
    trainer = quiet_trainer(max_steps=steps, val_check_interval=3, check_val_every_n_epoch=None, **settings)
    last = folder / "checkpoints" / LAST
    validation = torch.utils.data.DataLoader(torch.ones(1, 32))
    start = start or (last if last.is_file() else None)
    trainer.fit(module, Batches(), validation, ckpt_path=start, weights_only=True)
    figures = {name: value.item() for name, value in trainer.callback_metrics.items()}
    logger.log_metrics(figures, step=trainer.global_step)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))
