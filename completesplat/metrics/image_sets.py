"""Distances between the set of predicted and the set of true images, which need all images at once."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

Descriptors = list[Tensor]
"""Of some images, kinds of descriptors: each [images * n features]."""


@runtime_checkable
class SetMetric(Protocol):
    """Describes images one by one, and compares what it knows of two sets."""

    regions: tuple[str, ...]
    """Of the pixels that it looks at: "full", "object"."""

    def describe(self, images: Float[Tensor, "image 3 height width"], seeds: Sequence[int]) -> Descriptors:
        """What is kept of images with values in [0, 1]; whatever it draws for an image depends on its seed only."""
        ...

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """Figures by name, lower is better."""
        ...

    def settings(self) -> dict[str, dict[str, Any]]:
        """What figures depend on, by their names."""
        ...


class ImageSets:
    """Keeps what set metrics need of the images of each predictor, region and scene.

    Args:
        metrics: by any name.
    """

    TRUE = "true"

    def __init__(self, metrics: Sequence[SetMetric]) -> None:
        self.metrics = metrics
        self.kept: dict[tuple[str, str, int], dict[str, Descriptors]] = defaultdict(dict)

    def add(
        self, owner: str, region: str, scene: str, images: Float[Tensor, "image 3 height width"], seeds: Sequence[int]
    ) -> None:
        """Images of a scene that belong to a predictor, or are `TRUE`; those of a scene are kept once."""
        for index, metric in enumerate(self.metrics):
            scenes = self.kept[owner, region, index]
            if region in metric.regions and scene not in scenes:
                scenes[scene] = [kind.float().cpu() for kind in metric.describe(images, seeds)]

    def results(self, owner: str, region: str) -> dict[str, float]:
        """The distances of a predictor's images from the true ones of the same scenes."""
        found: dict[str, float] = {}
        for index, metric in enumerate(self.metrics):
            own, true = self.kept[owner, region, index], self.kept[self.TRUE, region, index]
            if own:
                order = sorted(own)
                found |= metric.distances(*(_joined([scenes[name] for name in order]) for scenes in (true, own)))
        return found

    def state(self) -> dict[Any, Any]:
        """What other processes need to know."""
        return dict(self.kept)

    def merge(self, state: dict[Any, Any]) -> None:
        """Add what another process kept."""
        for key, scenes in state.items():
            self.kept[key] |= scenes


def _joined(parts: Sequence[Descriptors]) -> Descriptors:
    return [torch.cat(kinds) for kinds in zip(*parts, strict=True)]
