"""Scenes with known hidden parts: all alternatives for what the reference image hides, with their probabilities."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.loading.view_selection import evaluation_views
from completesplat.errors import DataError
from completesplat.scene import SceneBatch
from completesplat.tensors import TensorDataclass

# A pixel is of the region if a channel differs between two modes by more than this; blurred edges differ less.
DIFFERENCE = 0.1
# Largest difference of modes in the reference image, which rounding to bytes may cause.
LEAK = 1.5 / 255
# Smallest share of an image that the region must cover.
SMALLEST_REGION = 0.005


@dataclass(frozen=True)
class HiddenModes(TensorDataclass):
    """One scene whose hidden part has several alternatives, the modes.

    Attributes:
        scene: a batch of one scene, with the modes' views among its targets.
        views: indices of the targets that show the modes.
        truths: images of these views in every mode, in [0, 1], with the same pixels as the data set's own images.
        region: pixels of these views that differ between the modes.
        probabilities: probabilities of the modes given the reference image.
        unseen: pixels of all targets whose surface the reference image does not show.
        true_mode: index of the mode that the data set's own images show.
    """

    scene: SceneBatch
    views: tuple[int, ...]
    truths: Float[Tensor, "mode view 3 height width"]
    region: Bool[Tensor, "view height width"]
    probabilities: Float[Tensor, " mode"]
    unseen: Bool[Tensor, "target height width"]
    modes: tuple[str, ...]
    true_mode: int


@runtime_checkable
class HiddenModeScenes(Protocol):
    """Sequence of scenes, each made when it is indexed."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> HiddenModes:
        """Return one scene.

        Raises:
            DataError: it is unreadable, its reference view distinguishes the modes, or no view shows them well.
            CompleteSplatError: the files were not made by the data set.
        """

    def versions(self, index: int) -> SceneBatch:
        """Return one scene in every mode [mode], with evenly spread targets; raise the errors of `__getitem__`."""


class Shown(NamedTuple):
    """Views that show the modes: their indices, their images in every mode, and the pixels that differ."""

    views: list[int]
    truths: Float[Tensor, "mode view 3 height width"]
    region: Bool[Tensor, "view height width"]


def differ(truths: Float[Tensor, "mode 3 height width"], by: float) -> Bool[Tensor, "height width"]:
    """Return the pixels in which two modes of one view differ by more than `by`."""
    return ((truths.amax(0) - truths.amin(0)) > by).any(0)


def views_of_modes(
    candidates: Iterable[int], truths_of: Callable[[int], Float[Tensor, "mode 3 height width"]], most: int, name: str
) -> Shown:
    """Select the first `most` views, of the best first, in which enough pixels differ between the modes.

    Raises:
        DataError: no view of the sequence `name` shows enough.
    """
    chosen = list[tuple[int, Tensor, Tensor]]()
    for view in candidates:
        truths = truths_of(view)
        region = differ(truths, DIFFERENCE)
        if region.float().mean() >= SMALLEST_REGION:
            chosen.append((view, truths, region))
        if len(chosen) == most:
            break
    if not chosen:
        raise DataError("no view shows enough of what the reference image hides", sequence=name)
    views, images, regions = zip(*chosen, strict=True)
    return Shown(list(views), torch.stack(images, dim=1), torch.stack(regions))


def spread_views(frames: int, reference: int, count: int) -> list[int]:
    """Return the indices of `count` evenly spread views other than the reference."""
    others = [view for view in range(frames) if view != reference]
    return [others[place - 1] for place in evaluation_views(frames, count)[1]]
