"""Scenes with known hidden parts: all alternatives for what the reference image hides, with their probabilities."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.loading.scenes import SceneStore, with_true_depths
from completesplat.data.loading.view_selection import evaluation_views
from completesplat.data.validation import field, finite_array, read_json
from completesplat.errors import BadAnnotation, DataError, errors_at
from completesplat.geometry.surfaces import hidden_from
from completesplat.scene import SceneBatch
from completesplat.tensors import TensorDataclass, stack

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


class HiddenModeScenes:
    """Sequence of scenes in all their modes, each read when it is indexed.

    The reference is a sequence's first frame, as in any test.

    Args:
        store: scenes as they were made, not prepared.
        modes: the same scenes in each mode, by its name.
        record: name -> JSON file of a sequence: its true mode (`hidden`), and the modes' `chances` if they are its own.
        chances: probabilities of the modes by name.
        views: largest number of views that show the modes.
        spread: number of further, evenly spread views.
    """

    def __init__(
        self,
        store: SceneStore,
        modes: Mapping[str, SceneStore],
        record: Callable[[str], Path],
        chances: Mapping[str, float],
        views: int,
        spread: int,
    ) -> None:
        self.store = store
        self.modes = modes
        self.record = record
        self.chances = chances
        self.views = views
        self.spread = spread

    def __len__(self) -> int:
        return len(self.store.names)

    def __getitem__(self, index: int) -> HiddenModes:
        """Return one scene.

        Raises:
            DataError: it is unreadable, its reference view distinguishes the modes, or no view shows them well.
        """
        name = self.store.names[index]
        sequence = self.store.source.read(name)
        truths = self._truths(name, len(sequence.frames))
        differences = truths.amax(0) - truths.amin(0)
        if (differences[0] > LEAK).any():
            raise DataError("the reference view tells the mode", sequence=name)
        regions = (differences > DIFFERENCE).any(1)
        best_first = differences.sum((1, 2, 3)).argsort(descending=True, stable=True).tolist()
        large = [view for view in best_first if view and regions[view].float().mean() >= SMALLEST_REGION]
        selected = large[: self.views]
        if not selected:
            raise DataError("no view shows enough of what the reference image hides", sequence=name)
        targets = sorted({*selected, *evaluation_views(len(sequence.frames), self.spread)[1]})
        scene = with_true_depths(self.store.scene(sequence, 0, targets), sequence, 0, targets)
        reference = scene.reference
        further = scene.targets
        assert reference.depths is not None
        assert further.depths is not None
        unseen, _ = hidden_from(reference.cameras, reference.depths, further.cameras, further.depths)
        views = list(map(targets.index, selected))
        region = regions[selected]
        # Depth maps leave out edges, but the reference view does not show what differs between the modes.
        unseen[views] |= region
        true_mode, probabilities = self._modes_of(name)
        return HiddenModes(
            scene=stack([scene]),
            views=tuple(views),
            truths=truths[:, selected],
            region=region,
            probabilities=probabilities,
            unseen=unseen,
            modes=tuple(self.chances),
            true_mode=true_mode,
        )

    def _modes_of(self, name: str) -> tuple[int, Float[Tensor, " mode"]]:
        """Return the index of a scene's true mode, and the probabilities of all modes."""
        record = self.record(name)
        modes = list(self.chances)
        with errors_at(record):
            content = read_json(record)
            hidden = field(content, "hidden", str)
            if hidden not in modes:
                raise BadAnnotation(f"hidden must be one of {', '.join(modes)}")
            stored = content.get("chances", list(self.chances.values()))
            chances = finite_array(stored, (len(modes),), "chances")
        return modes.index(hidden), torch.from_numpy(chances).float()

    def _truths(self, name: str, views: int) -> Float[Tensor, "mode view 3 size size"]:
        truths = []
        for store in self.modes.values():
            sequence = store.source.read(name)
            truths.append(torch.stack([store.image(sequence, view) for view in range(views)]))
        return torch.stack(truths).float() / 255
