"""Data module of rendered meshes, and their hidden modes: the images with every paint of the back."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.co3d.source import CO3DSource
from completesplat.data.hidden_modes import LEAK, HiddenModes, differ, spread_views, views_of_modes
from completesplat.data.loading.scenes import Choice, SceneStore, with_true_depths
from completesplat.data.rendered.drawing import PAINTS
from completesplat.data.rendered.rendering import CATEGORY, DESCRIPTION, OBJECT, in_mode
from completesplat.data.sequences import PosedSequence
from completesplat.data.validation import at, field, read_json
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.surfaces import hidden_from
from completesplat.scene import SceneBatch
from completesplat.tensors import stack


class RenderedHiddenModes:
    """Scenes of a store with all paints of the back; see `SceneDataModule.hidden_modes`.

    Args:
        folder: of the objects, rendered with hidden=modes.
        choose: returns a reference and targets, of which only the reference is used.

    Raises:
        CompleteSplatError: the objects were rendered otherwise, or `store` reads prepared data.
    """

    def __init__(
        self, folder: Path, store: SceneStore, choose: Callable[[PosedSequence], Choice], views: int, spread: int
    ) -> None:
        description = folder / DESCRIPTION
        if not isinstance(store.source, CO3DSource) or not description.is_file():
            raise DataError("hidden modes need data as they were rendered, not prepared", str(folder))
        with at(description):
            hidden = field(read_json(description), "hidden", str)
        if hidden != "modes":
            raise CompleteSplatError(f"{folder}: rendered with hidden={hidden}; hidden modes need hidden=modes")
        self.folder, self.store, self.choose, self.views, self.spread = folder, store, choose, views, spread
        self.modes = [replace(store, source=store.source.with_images(partial(in_mode, mode=mode))) for mode in PAINTS]

    def __len__(self) -> int:
        return len(self.store.names)

    def __getitem__(self, index: int) -> HiddenModes:
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
        record = self.folder / name / OBJECT
        with at(record):
            drawn = field(read_json(record), "hidden", str)
        chances = torch.tensor([paint.chance for paint in PAINTS.values()])
        views, true_mode = tuple(map(targets.index, shown.views)), list(PAINTS).index(drawn)
        return HiddenModes(stack([scene]), views, shown.truths, shown.region, chances, unseen, tuple(PAINTS), true_mode)

    def versions(self, index: int) -> SceneBatch:
        """See `HiddenModeScenes`."""
        name, sequence, reference = self._read(index)
        spread = spread_views(len(sequence.frames), reference, self.spread)
        return stack([store.scene(store.source.read(name), reference, spread) for store in self.modes])

    def _read(self, index: int) -> tuple[str, PosedSequence, int]:
        """Return the name of a scene, its sequence, and the index of its reference view."""
        name = self.store.names[index]
        sequence = self.store.source.read(name)
        reference, _ = self.choose(sequence)
        if differ(self._truths(name, reference), LEAK).any():
            raise DataError("the reference view tells the paint of the back", sequence=name)
        return name, sequence, reference

    def _truths(self, name: str, view: int) -> Float[Tensor, "mode 3 size size"]:
        return torch.stack([store.image(store.source.read(name), view).float() / 255 for store in self.modes])


class RenderedDataModule(CO3DDataModule):
    """`CO3DDataModule` of objects that `completesplat data render` wrote below `root`, split by seed."""

    def __init__(self, root: str, **settings: Any) -> None:
        super().__init__(root, CATEGORY, subset=None, **settings)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": CATEGORY}

    def hidden_modes(self, views: int, spread_views: int) -> RenderedHiddenModes:
        """Return the test scenes with all paints of the back; see `RenderedHiddenModes`."""
        choose = partial(self.evaluation_views, split="test")
        return RenderedHiddenModes(self.root / CATEGORY, self.store("test"), choose, views, spread_views)
