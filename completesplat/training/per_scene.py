"""Gaussians fitted to every scene by itself: what the representation could reach if nothing had to be predicted."""

from typing import Any

import torch

from completesplat.baselines.fitting import FittingSettings, fit_gaussians
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses import WeightedSum
from completesplat.scene import SceneBatch
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
