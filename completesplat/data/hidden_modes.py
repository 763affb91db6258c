"""Scenes with known hidden parts: all alternatives for what the reference image hides, with their probabilities."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.scene import SceneBatch
from completesplat.tensors import TensorDataclass


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
