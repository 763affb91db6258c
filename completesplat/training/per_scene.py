"""Gaussians fitted to every scene by itself, as they are and as Splatter Images."""

from typing import Any

import torch
from torchmetrics import MeanMetric

from completesplat.baselines.fitting import FittingSettings, fit_gaussians
from completesplat.baselines.preoptimized import project_to_splatter_image
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses import WeightedSum
from completesplat.scene import SceneBatch
from completesplat.splatter_image import Parameterization
from completesplat.training.scene_module import SceneModule


class PerScene(SceneModule):
    """An upper bound, not a competitor: it is fitted to all views, so it has seen those that it is scored on.

    It has nothing to train; all its work is done in evaluation.

    Args:
        loss: of the fit, weighted terms by name.
        fitting: number of Gaussians, steps and rates.
        **rendering_and_optimization: see `SceneModule`.
    """

    upper_bound = True

    def __init__(self, loss: WeightedSum, fitting: FittingSettings, **rendering_and_optimization: Any) -> None:
        super().__init__(**rendering_and_optimization)
        self.loss = loss
        self.fitting = fitting

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene to its reference and all its targets."""

        def render(gaussians: Gaussians, cameras: Cameras) -> torch.Tensor:
            return self.rasterizer(gaussians, cameras).over(self.background)

        generator = torch.Generator().manual_seed(seed)
        with torch.autocast(self.device.type, enabled=False):
            views = scenes.all_views()
            return fit_gaussians(views, scenes.depth_range, render, self.loss, self.fitting, generator)


class Preoptimized(PerScene):
    """What is left of fitted Gaussians in a Splatter Image of the reference view.

    Like `PerScene`, it has seen the views that it is scored on. The test logs the share of pixels without any Gaussian
    as `test/empty_pixels`, a mean over scenes; the paper reports 80 %.

    Args:
        parameterization: layers and activations of the Splatter Image.
        **fitting_and_rendering: see `PerScene`.
    """

    def __init__(self, parameterization: Parameterization, **fitting_and_rendering: Any) -> None:
        super().__init__(**fitting_and_rendering)
        self.parameterization = parameterization
        self.empty_pixels = MeanMetric()

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene, and keep what its reference view's Splatter Image has room for."""
        cameras, depth_range = scenes.reference.cameras, scenes.depth_range
        gaussians = super().reconstruct(scenes, seed)
        image, empty = project_to_splatter_image(gaussians, cameras, depth_range, self.parameterization)
        self.empty_pixels.update(empty.float().mean(dim=(1, 2)))
        return image.gaussians(cameras, depth_range)

    def on_test_start(self) -> None:
        super().on_test_start()
        self.empty_pixels.reset()

    def on_test_epoch_end(self) -> None:
        super().on_test_epoch_end()
        self.log("test/empty_pixels", self.empty_pixels)
