"""The supplement's "Pre-optimizing 3D Gaussian splats and projecting into Splatter Images"."""

from typing import Any

from torchmetrics import MeanMetric

from completesplat.baselines.projection import project_to_splatter_image
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.training.per_scene import PerScene


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
        return self.splatter_image(scenes, seed).gaussians(scenes.reference.cameras, scenes.depth_range)

    def splatter_image(self, scenes: SceneBatch, seed: int = 0) -> SplatterImage:
        """Each scene's fitted Gaussians in the pixels of its reference view."""
        gaussians, cameras = self.fitted(scenes, seed), scenes.reference.cameras
        image, empty = project_to_splatter_image(gaussians, cameras, scenes.depth_range, self.parameterization)
        self.empty_pixels.update(empty.float().mean(dim=(1, 2)))
        return image

    def fitted(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Gaussians fitted to each scene's reference and targets, in the reference camera's frame."""
        return super().reconstruct(scenes, seed)

    def on_test_start(self) -> None:
        super().on_test_start()
        self.empty_pixels.reset()

    def on_test_epoch_end(self) -> None:
        super().on_test_epoch_end()
        self.log("test/empty_pixels", self.empty_pixels)
