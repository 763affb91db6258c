"""What both training stages share: rendering a batch of scenes, and scoring the renders."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from completesplat.baselines.naive import copy_reference, repeat_image
from completesplat.gaussians import Gaussians
from completesplat.metrics.evaluation import Evaluation
from completesplat.metrics.images import psnr
from completesplat.rasterizers import Rasterizer
from completesplat.scene import SceneBatch


def prepare_network(network: nn.Module, channels_last: bool, compile: bool) -> None:
    """Settings of speed, in place; the state dict's keys stay as they are.

    Args:
        channels_last: order weights for convolutions in NHWC; its images should be too.
        compile: `torch.compile` the network on its first call.
    """
    if channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if compile:
        network.compile()


class SceneModule(LightningModule):
    """A model that turns reference images into Gaussians.

    Args:
        rasterizer: renders the Gaussians.
        optimizer: parameters -> optimizer.
        schedule: optimizer and steps of the run -> learning-rate schedule, stepped every optimizer step.
        background: grey value (0 to 1) seen where the Gaussians leave a pixel open.
    """

    upper_bound = False
    """Whether the model has seen the views that it is scored on."""

    def __init__(
        self,
        rasterizer: Rasterizer,
        optimizer: Callable[[Iterable[Tensor]], Optimizer],
        schedule: Callable[[Optimizer, float], LRScheduler],
        background: float = 0.5,
    ) -> None:
        super().__init__()
        self.rasterizer = rasterizer
        self.optimizer = optimizer
        self.schedule = schedule
        self.background = background

    @abstractmethod
    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """One set of Gaussians [batch] for each reference image, in its camera's frame."""

    def render(self, gaussians: Gaussians, scenes: SceneBatch) -> Float[Tensor, "batch view 3 height width"]:
        """The reference view and all targets, in full precision even where the network runs in less."""
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, scenes.all_views().cameras).over(self.background)

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        images = self.render(self.reconstruct(scenes, seed=index), scenes).clamp(0, 1)
        values = psnr(images[:, 1:].flatten(0, 1), scenes.targets.images.flatten(0, 1))
        self.log("val/psnr_novel", values.mean(), prog_bar=True, batch_size=len(images))

    def on_test_start(self) -> None:
        self.evaluation = Evaluation()
        self.mean_image = self.trainer.datamodule.mean_image()  # type: ignore[attr-defined]

    def test_step(self, scenes: SceneBatch, index: int) -> None:
        self.evaluation.update("model", self.render(self.reconstruct(scenes, seed=index), scenes), scenes)
        self.evaluation.update("mean_image", repeat_image(self.mean_image, scenes), scenes)
        self.evaluation.update("copy_reference", copy_reference(scenes), scenes)

    def configure_optimizers(self) -> Any:
        """The schedule spans the run, whether its length is given in steps or epochs."""
        optimizer = self.optimizer([p for p in self.parameters() if p.requires_grad])
        schedule = self.schedule(optimizer, self.trainer.estimated_stepping_batches)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
