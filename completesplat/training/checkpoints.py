"""Checkpoints: the moments at which they are written, their atomic files, and the choice of one that is whole."""

import logging
import os
import shutil
from contextlib import AbstractContextManager
from copy import deepcopy
from pathlib import Path
from time import monotonic
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from completesplat.data.loading.distributed import gather_values
from completesplat.errors import DivergenceError, WeightsError
from completesplat.files import atomic_path, make_folder
from completesplat.quantities import Positive
from completesplat.signals import keep_signals, restore_handlers
from completesplat.training.loggers import ContinuedCSVLogger
from completesplat.training.stopping import agreed_signal, end_training
from completesplat.weights.checkpoint_reading import check_whole, not_finite, read_checkpoint

LAST = "last.ckpt"
PREVIOUS = "previous.ckpt"
FIGURES = "figures"

logger = logging.getLogger(__name__)


class CheckpointFiles(TorchCheckpointIO):
    """Checkpoint files that are written beside their final place and renamed, so that they are whole or missing.

    Lightning's own class first builds the file in memory: 15 GB for 860 million parameters with optimizer and average.
    A checkpoint is a zip archive, with a checksum (CRC-32) for each of its parts.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: object = None
    ) -> None:
        """Replace the file at this path.

        Raises:
            DiskError: the disk refuses. The old file stays.
        """
        with _replaced(Path(path)) as unfinished:
            torch.save(checkpoint, unfinished)

    def load_checkpoint(self, path: str | os.PathLike[str], *options: object, **more: object) -> dict[str, Any]:
        """Load a checkpoint with `read_checkpoint`, on the CPU."""
        return read_checkpoint(Path(path))


class Checkpoints(Checkpoint):
    """Callback that replaces `last.ckpt` at intervals and at the end of training, and writes permanent milestones.

    Only one file is written each time: at a milestone this is `step=N.ckpt`, and `last.ckpt` becomes its second name (a
    hard link). A run that is killed at any moment leaves a whole `last.ckpt`. The checkpoint before it stays as
    `previous.ckpt` until the end of training.

    Loggers get the rows of a step after its last callback, so the file is written before the next batch, with the
    loops' state at the end of the step, also at the end of training, which Lightning counts as an epoch's. It also
    holds the figures so far, because the end of a run reports them.

    During training, signals are only recorded. After the step in which a process gets one, all processes save and end
    with `Interrupted`.

    Args:
        every_n_train_steps, every_minutes: optimizer steps or minutes between checkpoints; None: ignored.
        keep_every: optimizer steps between milestones; None: no milestones.
    """

    def __init__(
        self,
        folder: str,
        every_n_train_steps: Positive | None = None,
        every_minutes: float | None = None,
        keep_every: Positive | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.every_n_train_steps = every_n_train_steps
        self.every_minutes = every_minutes
        self.keep_every = keep_every
        self.due = False
        self.signal: int | None = None
        self.end_of_step: dict[str, object] | None = None
        self.figures: dict[str, Tensor] = {}

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        trainer.callback_metrics.update(self.figures)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.step = trainer.global_step
        self.saved_step = trainer.global_step
        self.saved_at = monotonic()
        for run_logger in trainer.loggers:
            if isinstance(run_logger, ContinuedCSVLogger):
                run_logger.experiment.goes_on_from = trainer.global_step
        if trainer.is_global_zero:
            for callback in trainer.checkpoint_callbacks:  # folders that a user gave to Lightning's own callback
                Path(getattr(callback, "dirpath", None) or self.folder.parent).mkdir(parents=True, exist_ok=True)
            make_folder(self.folder)  # only here: a run whose folder is removed must not go on
            resumed = Path(trainer.ckpt_path or "")
            last = self.folder / LAST
            if resumed != last and resumed.parent == self.folder:
                link(resumed, last)  # replace a damaged file, which must not become `previous.ckpt`
        restore_handlers()  # Lightning's wait for other processes within a step, for ever if these are gone
        keep_signals(True)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        # Several batches share an optimizer step if gradients are accumulated. Checkpoints lack accumulated gradients.
        stepped = trainer.global_step != self.step
        self.step = trainer.global_step
        if stepped:
            self.end_of_step = {"epoch": trainer.current_epoch, "fit_loop": deepcopy(trainer.fit_loop.state_dict())}
            self.signal = agreed_signal(trainer)
            self.due = self._is_milestone() or self._is_due(trainer) or self.signal is not None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        if self.due:
            self._save(trainer, pl_module)
        if self.signal is not None:
            end_training(trainer, self.signal)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step != self.saved_step:
            self._save(trainer, pl_module)
        if trainer.is_global_zero:
            (self.folder / PREVIOUS).unlink(missing_ok=True)
        keep_signals(False)
        signal = agreed_signal(trainer)
        if signal is not None:
            end_training(trainer, signal)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        keep_signals(False)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        if self.end_of_step is not None:
            checkpoint["epoch"] = self.end_of_step["epoch"]
            checkpoint["loops"]["fit_loop"] = self.end_of_step["fit_loop"]
        checkpoint[FIGURES] = {name: value.cpu() for name, value in trainer.callback_metrics.items()}

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        self.figures = checkpoint.get(FIGURES, {})

    def _is_milestone(self) -> bool:
        return self.keep_every is not None and self.step % self.keep_every == 0

    def _is_due(self, trainer: Trainer) -> bool:
        if self.every_n_train_steps is not None and self.step % self.every_n_train_steps == 0:
            return True
        if self.every_minutes is None:
            return False
        # All processes save together, although their clocks differ.
        return trainer.strategy.broadcast(monotonic() - self.saved_at >= 60 * self.every_minutes)

    def _save(self, trainer: Trainer, module: LightningModule) -> None:
        names = [name for name in gather_values(not_finite(module.state_dict())) if name is not None]
        if names:
            message = f"{names[0]} is not finite; no checkpoint is written of it, earlier ones stay in {self.folder}"
            raise DivergenceError(f"step {trainer.global_step}: {message}")
        self.due = False
        self.step = trainer.global_step
        self.saved_step = trainer.global_step
        self.saved_at = monotonic()
        last = self.folder / LAST
        if trainer.is_global_zero and last.is_file():
            link(last, self.folder / PREVIOUS)  # before the new file exists, so that there are never three
        if not self._is_milestone():
            return trainer.save_checkpoint(last)
        milestone = self.folder / f"step={self.step}.ckpt"
        trainer.save_checkpoint(milestone)
        if trainer.is_global_zero:
            link(milestone, last)
        trainer.strategy.barrier("Checkpoints")


def link(source: Path, target: Path) -> None:
    """Give a file a second name, which may be another file's until then, or copy it if there are no hard links."""
    with _replaced(target) as unfinished:
        try:
            os.link(source, unfinished)
        except OSError:
            shutil.copyfile(source, unfinished)


def _replaced(path: Path) -> AbstractContextManager[Path]:
    """Write a file atomically. Its unfinished file has a fixed name, so that repeated kills leave one at most."""
    return atomic_path(path, f".{path.name}.unfinished")


def newest_whole(last: Path) -> Path | None:
    """Return `last.ckpt`, or with a warning the newest older checkpoint if it is damaged or missing.

    Returns:
        None if there are no checkpoints.

    Raises:
        WeightsError: all of them are damaged.
    """
    milestones: dict[int, Path] = {}
    for path in last.parent.glob("step=*.ckpt"):
        step = path.stem.removeprefix("step=")
        if step.isdecimal():
            milestones[int(step)] = path
    newest_first = [milestones[step] for step in sorted(milestones, reverse=True)]
    refusal: WeightsError | None = None
    for path in (last, last.with_name(PREVIOUS), *newest_first):
        if not path.is_file():
            continue
        try:
            check_whole(path)
        except WeightsError as error:
            refusal = refusal or error
            continue
        if path != last:
            logger.warning("%s; going on from %s", refusal or f"{last}: is not there", path)
        return path
    if refusal is not None:
        raise refusal
    return None
