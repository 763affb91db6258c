"""Samples of a trained model as pictures, scene by scene."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import DataError
from completesplat.generation import CompleteSplat
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch


@dataclass(frozen=True)
class Artist:
    """Draws samples and renders them, the reference view first and then all targets.

    Args:
        background: grey value where a scene leaves a pixel open.
        samples: scenes drawn for an input, from the same noise whatever the settings.
    """

    model: CompleteSplat
    rasterizer: Rasterizer
    background: float
    samples: int
    seed: int

    def __call__(self, scene: SceneBatch, **settings: Any) -> Float[Tensor, "sample view 3 height width"]:
        """Renders of one scene (a batch of one) over the background, in [0, 1]; see `render`."""
        return self.over_background(self.render(scene, **settings))

    def over_background(self, rendering: Rendering) -> Float[Tensor, "*batch 3 height width"]:
        """Renders in [0, 1]."""
        return rendering.over(self.background).clamp(0, 1)

    @torch.no_grad()
    def render(self, scene: SceneBatch, **settings: Any) -> Rendering:
        """Colour, depth and opacity of one scene (a batch of one), [sample view].

        Args:
            **settings: of `CompleteSplat.generate`.
        """
        reference = scene.reference
        gaussians = self.model.generate(
            reference.images,
            reference.cameras,
            scene.depth_range,
            samples=self.samples,
            seed=self.seed,
            **settings,
        )
        cameras = scene.all_views().cameras.map(lambda tensor: tensor.expand(self.samples, *tensor.shape[1:]))
        return self.rasterizer(gaussians, cameras)


def first_scenes(data: Any, count: int) -> Iterator[SceneBatch]:
    """The first test scenes of a data module, each as a batch of one.

    Raises:
        DataError: there are less.
    """
    data.setup("test")
    found = 0
    for batch in data.test_dataloader():
        for index in range(len(batch.names)):
            if found < count:
                yield batch[index : index + 1]
            found += 1
        if found >= count:
            return
    raise DataError(f"there are {found} test scenes, not scenes={count}", str(data.root))
