"""Scenes of which it is known what the reference picture hides: all that could be there, and how probable each is."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.scene import SceneBatch
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class HiddenModes(TensorDataclass):
    """One scene whose hidden part takes one of several forms, the modes.

    Attributes:
        scene: a batch of one, with the modes' views among its targets.
        views: the places in the targets of the views that show the modes.
        truths: the pictures of those views in every mode, in [0, 1], in the pixels of the data set's own pictures.
        region: pixels of those views that differ between the modes.
        probabilities: of the modes, given the reference picture.
        unseen: pixels of all targets whose surface the reference picture does not show.
        true_mode: the mode that the data set's own pictures show.
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
    """Scenes that are made one by one, when they are indexed."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> HiddenModes:
        """One scene.

        Raises:
            DataError: it is unreadable, its reference view tells the modes apart, or no view shows them well.
            CompleteSplatError: the files are not those that the data set made.
        """


@runtime_checkable
class KnowsHiddenModes(Protocol):
    """A data module that can tell what else could be where the reference picture shows nothing."""

    def hidden_modes(self, views: int, spread_views: int) -> HiddenModeScenes:
        """All test scenes: at most `views` views that show the modes best, and further targets evenly spread."""


def hidden_modes(data: Any, views: int, spread_views: int) -> HiddenModeScenes:
    """What `data.hidden_modes` gives; `CompleteSplatError` if it knows of none, or has files that it did not make."""
    if not isinstance(data, KnowsHiddenModes):
        raise CompleteSplatError("evaluation=hidden_modes needs data whose hidden parts are known: toy objects")
    return data.hidden_modes(views, spread_views)
