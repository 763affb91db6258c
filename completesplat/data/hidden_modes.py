"""Scenes with known hidden parts: all alternatives for what the reference image hides, with their probabilities.

The data are in CO3D's layout. Beside its `images`, a sequence has a folder with the same images in each mode, named
after the mode.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.co3d.source import CO3DSource
from completesplat.data.loading.scenes import Choice, SceneStore, with_true_depths
from completesplat.data.loading.view_selection import evaluation_views
from completesplat.data.sequences import PosedSequence
from completesplat.data.validation import BadAnnotation, at, field, finite_array, read_json
from completesplat.errors import DataError
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


def in_mode(image: Path, mode: str) -> Path:
    """Return the path of an image in a mode, given that of the image in `images`."""
    return image.parent.parent / mode / image.name


class HiddenModeScenes:
    """Sequence of scenes in all their modes, each read when it is indexed; see `SceneDataModule.hidden_modes`.

    Args:
        record: JSON file of a sequence: its true mode (`hidden`), and the modes' `chances` if they are its own.
        chances: probabilities of the modes by name.
        choose: returns a reference and targets, of which only the reference is used.

    Raises:
        DataError: `store` reads prepared data.
    """

    def __init__(
        self,
        store: SceneStore,
        record: Callable[[str], Path],
        chances: Mapping[str, float],
        choose: Callable[[PosedSequence], Choice],
        views: int,
        spread: int,
    ) -> None:
        if not isinstance(store.source, CO3DSource):
            raise DataError("hidden modes need data as they were made, not prepared")
        self.store, self.record, self.chances, self.choose = store, record, chances, choose
        self.views, self.spread = views, spread
        self.modes = [replace(store, source=store.source.with_images(partial(in_mode, mode=mode))) for mode in chances]

    def __len__(self) -> int:
        return len(self.store.names)

    def __getitem__(self, index: int) -> HiddenModes:
        """Return one scene.

        Raises:
            DataError: it is unreadable, its reference view distinguishes the modes, or no view shows them well.
        """
        name, sequence, reference = self._read(index)
        candidates = [view for view in range(len(sequence.frames)) if view != reference]
        truths = {view: self._truths(name, view) for view in candidates}
        extent = {view: (images.amax(0) - images.amin(0)).sum().item() for view, images in truths.items()}
        candidates.sort(key=extent.__getitem__, reverse=True)
        shown = views_of_modes(candidates, truths.__getitem__, self.views, name)
        targets = sorted({*shown.views, *spread_views(len(sequence.frames), reference, self.spread)})
        scene = with_true_depths(self.store.scene(sequence, reference, targets), sequence, reference, targets)
        front, others = scene.reference, scene.targets
        assert front.depths is not None
        assert others.depths is not None
        unseen, _ = hidden_from(front.cameras, front.depths, others.cameras, others.depths)
        views, modes = tuple(map(targets.index, shown.views)), tuple(self.chances)
        true_mode, probabilities = self._modes_of(name)
        return HiddenModes(stack([scene]), views, shown.truths, shown.region, probabilities, unseen, modes, true_mode)

    def versions(self, index: int) -> SceneBatch:
        """Return one scene in every mode [mode], with evenly spread targets; raise the errors of `__getitem__`."""
        name, sequence, reference = self._read(index)
        spread = spread_views(len(sequence.frames), reference, self.spread)
        return stack([store.scene(store.source.read(name), reference, spread) for store in self.modes])

    def _read(self, index: int) -> tuple[str, PosedSequence, int]:
        """Return the name of a scene, its sequence, and the index of its reference view."""
        name = self.store.names[index]
        sequence = self.store.source.read(name)
        reference, _ = self.choose(sequence)
        if differ(self._truths(name, reference), LEAK).any():
            raise DataError("the reference view tells the mode", sequence=name)
        return name, sequence, reference

    def _modes_of(self, name: str) -> tuple[int, Float[Tensor, " mode"]]:
        """Return the index of a scene's true mode, and the probabilities of all modes."""
        record, modes = self.record(name), list(self.chances)
        with at(record):
            content = read_json(record)
            hidden = field(content, "hidden", str)
            if hidden not in modes:
                raise BadAnnotation(f"hidden must be one of {', '.join(modes)}")
            chances = finite_array(content.get("chances", list(self.chances.values())), (len(modes),), "chances")
        return modes.index(hidden), torch.from_numpy(chances).float()

    def _truths(self, name: str, view: int) -> Float[Tensor, "mode 3 size size"]:
        return torch.stack([store.image(store.source.read(name), view).float() / 255 for store in self.modes])


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
