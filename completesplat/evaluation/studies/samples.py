"""Samples of a trained model, scene by scene: drawn, rendered and measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.errors import DataError
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras
from completesplat.metrics import PSNR_LIMIT
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.sampling_settings import Sampling
from completesplat.scene import SceneBatch


@dataclass(frozen=True)
class SampleRenderer:
    """Renderer of samples (from the same noise, whatever the settings) in the reference view and then all targets.

    `background` is the grey value behind the Gaussians.
    """

    model: CompleteSplat
    rasterizer: Rasterizer
    background: float
    samples: int
    seed: int

    def __call__(self, scene: SceneBatch, **settings: Any) -> Float[Tensor, "sample view 3 height width"]:
        """Render one scene (a batch of one) over the background, in [0, 1]. See `render`."""
        return self.over_background(self.render(scene, **settings))

    def over_background(self, rendering: Rendering) -> Float[Tensor, "*batch 3 height width"]:
        """Composite a rendering over the background and clip it to [0, 1]."""
        return rendering.over(self.background).clamp(0, 1)

    @torch.no_grad()
    def render(self, scene: SceneBatch, **settings: Any) -> Rendering:
        """Render colour, depth and opacity [sample view] of one scene (a batch of one).

        Args:
            **settings: fields of `Sampling`.
        """
        reference = scene.reference
        sampling = replace(Sampling(samples=self.samples, seed=self.seed), **settings)
        gaussians = self.model.generate(reference.images, reference.cameras, scene.depth_range, sampling)
        return self.rasterizer(gaussians, scene.all_views().cameras[0].repeated(len(gaussians.means)))


def first_scenes(data: SceneDataModule, count: int) -> list[SceneBatch]:
    """Return the first test scenes of a data module, each as a batch of one."""
    data.setup("test")
    all_scenes = (batch[i : i + 1] for batch in data.test_dataloader() for i in range(len(batch.names)))
    scenes = list(islice(all_scenes, count))
    if len(scenes) < count:
        raise DataError(f"there are {len(scenes)} test scenes, not scenes={count}", str(data.root))
    return scenes


def object_psnr(
    images: Float[Tensor, "sample view 3 height width"],
    true: Float[Tensor, "view 3 height width"],
    masks: Float[Tensor, "view 1 height width"],
) -> float | None:
    """Return the samples' PSNR (dB) over the true object's pixels of all views together, or None without pixels."""
    inside = (masks > 0.5).expand_as(true)
    if not inside.any():
        return None
    error = (images - true).square().mean(0)[inside].mean().item()
    return -10 * math.log10(max(error, 10 ** (-PSNR_LIMIT / 10)))


def near_reference(reference: Cameras, targets: Cameras, degrees: float) -> Bool[Tensor, " view"]:
    """Return a mask of the targets [view] whose optical axes are at most this far from the reference's."""
    return _cosines(reference, targets) >= math.cos(math.radians(degrees))


def farthest(scene: SceneBatch) -> int:
    """Return the index in `all_views` of the target whose direction differs most from the reference's, of one scene."""
    return 1 + int(_cosines(scene.reference.cameras[0], scene.targets.cameras[0]).argmin())


def _cosines(reference: Cameras, targets: Cameras) -> Float[Tensor, " view"]:
    """Return the cosines of the angles between the reference's optical axis and the targets'."""
    return targets.world_to_camera[:, 2, :3] @ reference.world_to_camera[2, :3]


def mean_over_scenes(measured: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Return the mean of each figure over the scenes that have it, or None if none has."""
    means: dict[str, float | None] = {}
    for key in measured[0]:
        values = [value for value in (row[key] for row in measured) if value is not None]
        means[key] = sum(values) / len(values) if values else None
    return means
