"""What a model makes of a few fixed scenes while it trains: pictures, and how its Gaussians are distributed."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import WandbLogger

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch
from completesplat.tensors import stack
from completesplat.training.callbacks import ExponentialMovingAverage
from completesplat.training.panels import scene_panels, sheet
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.scene_module import SceneModule

PERCENTILES = (10, 50, 90)


class Pictures(Callback):
    """Draws the first scenes of the validation set, or of the training set if there is no other.

    `folder/step_000500.png` has a row for each scene (`scene_panels`). All loggers get `gaussians/opacity_p10`, `_p50`,
    `_p90`, the same of `log10_scale` (all three axes) and `depth` (along the reference's optical axis, in scene
    units), and `kl/channel_0` and so on if the model has a posterior; Weights & Biases also the picture and histograms.
    The model is in evaluation mode, with averaged weights if training keeps them. Training is the same without.

    Args:
        folder: of the pictures.
        every_n_steps: optimizer steps between them; there is another one at the end of training.
        scenes: how many.
    """

    def __init__(self, folder: str, every_n_steps: int = 1000, scenes: int = 4) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.count = scenes

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.scenes: SceneBatch | None = None
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
            if self.scenes is None:
                self.scenes = fixed_scenes(trainer.datamodule, self.count)  # type: ignore[attr-defined]
            self._draw(trainer, module, self.scenes.to(module.device))

    def _draw(self, trainer: Trainer, module: SceneModule, scenes: SceneBatch) -> None:
        with trainer.precision_plugin.forward_context():
            gaussians = module.reconstruct(scenes, seed=0)
            posterior = module(scenes).posterior if isinstance(module, ReconstructionModule) else None
        with torch.autocast(module.device.type, enabled=False):
            picture = sheet(scene_panels(module.rasterizer, gaussians, scenes, module.background))
        self.folder.mkdir(parents=True, exist_ok=True)
        picture.save(self.folder / f"step_{trainer.global_step:06}.png")

        values = distributions(gaussians)
        scalars = {f"gaussians/{name}": value for name, value in percentiles(values).items()}
        if posterior is not None:
            scalars |= {f"kl/channel_{index}": kl for index, kl in enumerate(channel_kl(posterior))}
        for logger in trainer.loggers:
            # As Lightning counts: a row bears the number of the optimizer steps before its own.
            logger.log_metrics(scalars, step=trainer.global_step - 1)
            if isinstance(logger, WandbLogger):
                import wandb

                media: Any = {f"histograms/{name}": wandb.Histogram(of.tolist()) for name, of in values.items()}
                logger.log_metrics(media | {"pictures": wandb.Image(picture)}, step=trainer.global_step - 1)


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


def fixed_scenes(data: Any, count: int) -> SceneBatch:
    """The first validation scenes, or training scenes where the data have no others, with their first target."""
    found: list[SceneBatch] = []
    for batch in data.val_dataloader() or data.train_dataloader():
        for index in range(len(batch.names)):
            scene = batch[index]
            found.append(replace(scene, targets=scene.targets[:1]))
        if len(found) >= count:
            break
    return stack(found[:count])


def distributions(gaussians: Gaussians) -> dict[str, Float[np.ndarray, " value"]]:
    """Opacities, decimal logarithms of the scales, and depths, of all Gaussians in their reference's frame."""
    values = {
        "opacity": gaussians.opacities,
        "log10_scale": gaussians.scales.log10(),
        "depth": gaussians.means[..., 2],
    }
    return {name: value.float().flatten().cpu().numpy() for name, value in values.items()}


def percentiles(values: Mapping[str, Float[np.ndarray, " _"]]) -> dict[str, float]:
    """`name_p10` and so on for each."""
    return {f"{name}_p{p}": float(np.percentile(of, p)) for name, of in values.items() for p in PERCENTILES}


def channel_kl(posterior: Posterior) -> list[float]:
    """KL divergence to the prior of each channel of the latent: summed over space, mean over the batch."""
    means, log_variances = posterior.mean.split(1, dim=1), posterior.log_variance.split(1, dim=1)
    return [Posterior(*parts).kl().mean().item() for parts in zip(means, log_variances, strict=True)]
