"""Drawing the same few scenes again and again while a model trains, without any influence on it."""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from completesplat.scene import SceneBatch
from completesplat.training.callbacks import ExponentialMovingAverage
from completesplat.training.scene_module import SceneModule


class DrawsFixedScenes(Callback):
    """Draws the first scenes of the validation set.

    The model is in evaluation mode, with averaged weights if training keeps them. Training is the same without.

    Args:
        folder: of the pictures.
        every_n_steps: optimizer steps between them; there is another one at the end of training.
        scenes: how many.
        views: targets of a scene, evenly spread over those that it has; all, if these are fewer.
    """

    def __init__(self, folder: str, every_n_steps: int, scenes: int, views: int) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.count = scenes
        self.views = views

    @abstractmethod
    def draw(self, trainer: Trainer, module: SceneModule, scenes: list[SceneBatch]) -> None:
        """Write and log what the model makes of the scenes [view], which are on the CPU."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.scenes: list[SceneBatch] = []
        self.drawn = trainer.global_step

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if trainer.global_step % self.every_n_steps == 0:
            self._draw_once(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._draw_once(trainer, pl_module)

    def _draw_once(self, trainer: Trainer, module: LightningModule) -> None:
        if trainer.global_step == self.drawn or not trainer.is_global_zero:
            return
        assert isinstance(module, SceneModule)
        self.drawn = trainer.global_step
        with untouched(trainer, module):
            if not self.scenes:
                self.scenes = fixed_scenes(trainer.datamodule, self.count, self.views)  # type: ignore[attr-defined]
            self.folder.mkdir(parents=True, exist_ok=True)
            self.draw(trainer, module, self.scenes)


@contextmanager
def untouched(trainer: Trainer, module: LightningModule) -> Iterator[None]:
    """Evaluation with averaged weights if there are any; afterwards all is as it was, random numbers too."""
    modes = {part: part.training for part in module.modules()}
    with ExitStack() as contexts:
        contexts.enter_context(torch.no_grad())
        contexts.enter_context(torch.random.fork_rng([module.device] if module.device.type == "cuda" else []))
        for callback in trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, ExponentialMovingAverage):
                contexts.enter_context(callback.in_place(module))
        module.eval()
        try:
            yield
        finally:
            for part, mode in modes.items():
                part.training = mode


def fixed_scenes(data: Any, count: int, views: int = 1) -> list[SceneBatch]:
    """The first validation scenes, with some of their targets."""
    found: list[SceneBatch] = []
    for batch in data.val_dataloader():
        for index in range(len(batch.names)):
            scene = batch[index]
            targets = len(scene.targets.images)
            chosen = [i * targets // views for i in range(views)] if targets > views else list(range(targets))
            found.append(replace(scene, targets=scene.targets[chosen]))
        if len(found) >= count:
            break
    return found[:count]
