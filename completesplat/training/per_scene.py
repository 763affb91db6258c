"""Gaussians fitted to every scene by itself, as they are and as Splatter Images."""

import logging
from pathlib import Path
from typing import Any

import torch

from completesplat.baselines.fitting import FittingSettings, fit_gaussians
from completesplat.baselines.preoptimized import project_to_splatter_image
from completesplat.data.loading.distributed import gathered
from completesplat.errors import CompleteSplatError
from completesplat.export.prediction import write_fitted_scene
from completesplat.files import safe_name
from completesplat.gaussians import Gaussians
from completesplat.losses import WeightedSum
from completesplat.scene import SceneBatch
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.training.stage import ScoredScene, Stage

logger = logging.getLogger(__name__)


class PerScene(Stage):
    """An upper bound, not a competitor: it is fitted to all views, so it has seen those that it is scored on.

    It has nothing to train; all its work is done in evaluation. `loss` is that of the fit.

    Args:
        scenes_folder: a folder for each scene of a test is written there (`write_fitted_scene`); None: none are.
    """

    upper_bound = True

    def __init__(
        self,
        loss: WeightedSum,
        fitting: FittingSettings,
        scenes_folder: str | None = None,
        **rendering_and_optimization: Any,
    ) -> None:
        super().__init__(**rendering_and_optimization)
        self.loss = loss
        self.fitting = fitting
        self.scenes_folder = None if scenes_folder is None else Path(scenes_folder)

    def scene_scored(self, scene: ScoredScene) -> None:
        """Write it, too; of one that has nothing that could be written, a warning."""
        super().scene_scored(scene)
        if self.scenes_folder is None:
            return
        folder, seed = self.scenes_folder / safe_name(scene.name), self.evaluation.scene_seed(scene.name)
        try:
            write_fitted_scene(
                folder, scene.name, scene.gaussians[0], scene.cameras, scene.images[0], scene.truth.images, seed
            )
        except CompleteSplatError as error:
            logger.warning("%s: %s", folder, error)

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene to its reference and all its targets."""
        render = lambda gaussians, cameras: self.rasterizer(gaussians, cameras).over(self.background)  # noqa: E731
        generator = torch.Generator().manual_seed(seed)
        with torch.autocast(self.device.type, enabled=False):
            views = scenes.all_views()
            return fit_gaussians(views, scenes.depth_range, render, self.loss, self.fitting, generator)


class Preoptimized(PerScene):
    """What is left of fitted Gaussians in a Splatter Image of the reference view.

    Like `PerScene`, it has seen the views that it is scored on. The results of a test have the share of pixels without
    any Gaussian as `empty_pixels`, a mean over scenes; the paper reports 80 %.
    """

    def __init__(self, parameterization: Parameterization, **fitting_and_rendering: Any) -> None:
        super().__init__(**fitting_and_rendering)
        self.parameterization = parameterization
        self._empty: dict[str, float] = {}

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene, and keep what its reference view's Splatter Image has room for."""
        return self.splatter_image(scenes, seed).gaussians(scenes.reference.cameras, scenes.depth_range)

    def splatter_image(self, scenes: SceneBatch, seed: int = 0) -> SplatterImage:
        """Each scene's fitted Gaussians in the pixels of its reference view."""
        gaussians, cameras = self.fitted(scenes, seed), scenes.reference.cameras
        image, empty = project_to_splatter_image(gaussians, cameras, scenes.depth_range, self.parameterization)
        self._empty |= dict(zip(scenes.names, empty.float().mean(dim=(1, 2)).tolist(), strict=True))
        return image

    def fitted(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Gaussians fitted to each scene's reference and targets, in the reference camera's frame."""
        return super().reconstruct(scenes, seed)

    def on_test_start(self) -> None:
        super().on_test_start()
        self._empty = {}

    def test_results(self) -> dict[str, Any]:
        """Return those of `Stage`, and `empty_pixels`, the mean over the scenes of all processes."""
        results = super().test_results()
        empty = {name: share for shares in gathered(self._empty) for name, share in shares.items()}
        results["model"]["empty_pixels"] = sum(empty.values()) / max(len(empty), 1)
        return results
