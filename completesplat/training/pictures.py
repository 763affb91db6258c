"""What a model makes of a few fixed scenes while it trains: pictures, and how its Gaussians are distributed."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning import Trainer
from lightning.pytorch.loggers import WandbLogger

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch
from completesplat.tensors import stack
from completesplat.training.fixed_scenes import DrawsFixedScenes
from completesplat.training.panels import scene_panels, sheet
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.scene_module import SceneModule

PERCENTILES = (10, 50, 90)


class Pictures(DrawsFixedScenes):
    """What the first target of each scene looks like, and what its Gaussians are like; see `DrawsFixedScenes`.

    `folder/step_000500.png` has a row for each scene (`scene_panels`). All loggers get `gaussians/opacity_p10`, `_p50`,
    `_p90`, the same of `log10_scale` (all three axes) and `depth` (along the reference's optical axis, in scene
    units). If the model has a posterior, they also get what its latent carries (`latent_bits`). Weights & Biases gets
    the picture and histograms too.
    """

    def __init__(self, folder: str, every_n_steps: int = 1000, scenes: int = 4) -> None:
        super().__init__(folder, every_n_steps, scenes, views=1)

    def draw(self, trainer: Trainer, module: SceneModule, scenes: list[SceneBatch]) -> None:
        batch = stack(scenes).to(module.device)
        with trainer.precision_plugin.forward_context():
            gaussians = module.reconstruct(batch, seed=0)
            posterior = module(batch).posterior if isinstance(module, ReconstructionModule) else None
        with torch.autocast(module.device.type, enabled=False):
            picture = sheet(scene_panels(module.rasterizer, gaussians, batch, module.background))
        picture.save(self.folder / f"step_{trainer.global_step:06}.png")

        values = distributions(gaussians)
        scalars = {f"gaussians/{name}": value for name, value in percentiles(values).items()}
        if posterior is not None:
            scalars |= latent_bits(posterior)
        for logger in trainer.loggers:
            # As Lightning counts: a row bears the number of the optimizer steps before its own.
            logger.log_metrics(scalars, step=trainer.global_step - 1)
            if isinstance(logger, WandbLogger):
                import wandb

                media: Any = {f"histograms/{name}": wandb.Histogram(of.tolist()) for name, of in values.items()}
                logger.log_metrics(media | {"pictures": wandb.Image(picture)}, step=trainer.global_step - 1)


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


def latent_bits(posterior: Posterior) -> dict[str, float]:
    """KL of the latent to the prior: `latent/bits` a scene, of which `latent/bits_0` and so on in each channel.

    `latent/active_channels` counts the channels that are active (`completesplat.autoreconstructor.posterior`).
    """
    bits = posterior.channel_bits().tolist()
    channels = {f"latent/bits_{index}": value for index, value in enumerate(bits)}
    return {"latent/bits": sum(bits), "latent/active_channels": float(posterior.active_channels()), **channels}
