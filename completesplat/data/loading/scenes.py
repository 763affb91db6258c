"""Scenes made of sequences: views in the reference's frame; what cannot be read is passed on, not raised."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from completesplat.data.loading.distributed import processes
from completesplat.data.loading.view_selection import draws
from completesplat.data.sequences import Picture, PosedSequence, SequenceSource
from completesplat.data.validation import at
from completesplat.errors import DataError
from completesplat.scene import CachedScene, SceneBatch, Views
from completesplat.tensors import stack

# So many other items are tried in the place of one that cannot be read.
ATTEMPTS = 10

Choice = tuple[int, list[int]]  # reference, targets


class Loaded(NamedTuple):
    """A scene, or a batch of them, and why others could not be read.

    `refused_depths`: why scenes are here without their true depth, although the data have it.
    """

    scenes: SceneBatch | CachedScene | None
    refused: tuple[DataError, ...]
    refused_depths: tuple[DataError, ...] = ()


class SceneStore:
    """Makes scenes of some of a source's sequences, which `names` lists in order.

    Args:
        mask_threshold: masks become 1 where the foreground's probability reaches it and 0 elsewhere; None: they stay.
        cache: keep decoded pictures (uint8) in memory, each from its first use on.
        background: grey value (0 to 1) that pictures have where they are masked out; None: they stay.
    """

    def __init__(
        self,
        source: SequenceSource,
        names: Sequence[str],
        mask_threshold: float | None = None,
        cache: bool = False,
        background: float | None = None,
    ) -> None:
        self.source = source
        self.names = list(names)
        self.mask_threshold = mask_threshold
        self.background = background
        self._pictures: dict[tuple[str, int], Picture] | None = {} if cache else None

    def scene(self, sequence: PosedSequence, reference: int, targets: Sequence[int]) -> SceneBatch:
        """One scene in the reference camera's frame, from the frames of these indices; `DataError` if unreadable."""
        views = [reference, *targets]
        pictures = [self._picture(sequence, view) for view in views]
        images = _shares([picture.image for picture in pictures])
        masks = self._masks(pictures)
        cameras = sequence.cameras[views].relative_to(sequence.cameras[reference]).to(torch.float32)
        seen, visible = Views(images, cameras, masks), torch.ones_like(masks[0])
        ranges, frame = sequence.depth_ranges[reference], torch.tensor(reference)
        return SceneBatch(seen[0], seen[1:], ranges, visible, frame, sequence.name)

    def image(self, sequence: PosedSequence, view: int) -> UInt8[Tensor, "3 height width"]:
        """One picture. Raises `DataError` if it cannot be read."""
        return self._picture(sequence, view).image

    def _picture(self, sequence: PosedSequence, view: int) -> Picture:
        key = sequence.name, view
        if self._pictures is None:
            return self._on_background(sequence.read(view))
        if key not in self._pictures:
            self._pictures[key] = self._on_background(sequence.read(view))
        return self._pictures[key]

    def _masks(self, pictures: Sequence[Picture]) -> Float[Tensor, "view 1 size size"]:
        everywhere = torch.full_like(pictures[0].image[:1], 255)
        masks = _shares([everywhere if picture.mask is None else picture.mask for picture in pictures])
        return masks if self.mask_threshold is None else (masks >= self.mask_threshold).float()

    def _on_background(self, picture: Picture) -> Picture:
        if self.background is None or picture.mask is None:
            return picture
        mask = self._masks([picture])[0].numpy()
        mixed = np.rint(picture.image.numpy() * mask + 255 * self.background * (1 - mask))
        return picture._replace(image=torch.from_numpy(mixed.astype(np.uint8)))


def _shares(pictures: Sequence[UInt8[Tensor, "_ size size"]]) -> Float[Tensor, "view _ size size"]:
    # By NumPy: torch would wake its threads for so little, and they would wait on cores that others need.
    return torch.from_numpy(np.divide([picture.numpy() for picture in pictures], 255, dtype=np.float32))


class TrainingScenes(Dataset[Loaded]):
    """Scenes of random views; a key is (epoch, index), see `EpochSampler`.

    An item that cannot be read is replaced by another one. What is drawn, also then, depends on (seed, epoch, index)
    only.

    `choose` is (number of a sequence's frames, epoch, random generator) -> views; `references` are items of a sequence
    in one epoch.
    """

    def __init__(
        self,
        store: SceneStore,
        choose: Callable[[int, int, np.random.Generator], Choice],
        augment: Callable[[SceneBatch, np.random.Generator], SceneBatch],
        references: int,
        seed: int,
    ) -> None:
        self.store = store
        self.choose = choose
        self.augment = augment
        self.references = references
        self.seed = seed

    def __len__(self) -> int:
        return len(self.store.names) * self.references

    def __getitem__(self, key: tuple[int, int]) -> Loaded:
        epoch, index = key
        rng = draws(self.seed, epoch, index)
        refused: list[DataError] = []
        for _ in range(ATTEMPTS):
            name = self.store.names[index // self.references]
            try:
                with at(sequence=name):
                    return Loaded(self.draw(name, epoch, rng), tuple(refused))
            except DataError as error:
                refused.append(error)
                index = int(rng.integers(len(self)))
        return Loaded(None, tuple(refused))

    def draw(self, name: str, epoch: int, rng: np.random.Generator) -> SceneBatch | CachedScene:
        """A scene of random views of the sequence of this name; `DataError` if it or a picture cannot be read."""
        sequence = self.store.source.read(name)
        scene = self.store.scene(sequence, *self.choose(len(sequence.frames), epoch, rng))
        return self.augment(scene, rng)

    def groups(self) -> list[list[int]]:
        """Items that are best loaded one after the other."""
        several = range(self.references)
        groups = self.store.source.groups(self.store.names)
        return [[name * self.references + i for name in group for i in several] for group in groups]


class EvaluationScenes(Dataset[Loaded]):
    """Every sequence once, or those of some names.

    Args:
        choose: sequence -> views. Raises `DataError` where it has not got them.
        seen: makes what a model sees of them, in smaller pictures; None: it sees what the store makes.
        depths: read the true depth too, where the data have it.
    """

    def __init__(
        self,
        store: SceneStore,
        choose: Callable[[PosedSequence], Choice],
        names: Sequence[str] | None = None,
        seen: SceneStore | None = None,
        depths: bool = False,
    ) -> None:
        self.store = store
        self.choose = choose
        self.names = store.names if names is None else names
        self.seen = seen
        self.depths = depths

    def __len__(self) -> int:
        return len(self.names)

    def share(self, batch_size: int) -> "EvaluationScenes":
        """Return what this process evaluates: whole batches, made up as in one process alone.

        A process for which none is left evaluates the first scene again, because all must take part in what follows.
        """
        rank, count = processes()
        starts = range(rank * batch_size, len(self.names), count * batch_size)
        own = [name for start in starts for name in self.names[start : start + batch_size]]
        return EvaluationScenes(self.store, self.choose, own or self.names[:1], self.seen, self.depths)

    def __getitem__(self, index: int) -> Loaded:
        name = self.names[index]
        try:
            sequence = self.store.source.read(name)
            views = self.choose(sequence)
            scene = self.store.scene(sequence, *views)
            if self.seen is not None:
                scene = replace(scene, seen=self.seen.scene(self.seen.source.read(name), *views))
        except DataError as error:
            return Loaded(None, (error,))
        try:
            if self.depths and sequence.read_depth is not None:
                scene = _with_depths(scene, torch.stack([sequence.read_depth(view) for view in (views[0], *views[1])]))
        except DataError as error:
            return Loaded(scene, (), (error,))
        return Loaded(scene, ())

    def stackable(self) -> bool:
        """Whether all scenes have the same number of targets, as far as they can be read."""
        counts = set()
        for name in self.names:
            with suppress(DataError):
                counts.add(len(self.choose(self.store.source.read(name))[1]))
        return len(counts) <= 1


def _with_depths(scene: SceneBatch, depths: Float[Tensor, "view 1 height width"]) -> SceneBatch:
    reference, targets = replace(scene.reference, depths=depths[0]), replace(scene.targets, depths=depths[1:])
    return replace(scene, reference=reference, targets=targets)


def collate(items: Sequence[Loaded]) -> Loaded:
    """A batch of the scenes that are there; where only some of them have depths, those of the others are 0, unknown."""
    scenes = [item.scenes for item in items if item.scenes is not None]
    with_depths = [isinstance(scene, SceneBatch) and scene.reference.depths is not None for scene in scenes]
    if any(with_depths):
        scenes = [scene if has else _with_unknown_depths(scene) for scene, has in zip(scenes, with_depths, strict=True)]
    return Loaded(
        stack(scenes) if scenes else None,
        tuple(error for item in items for error in item.refused),
        tuple(error for item in items for error in item.refused_depths),
    )


def _with_unknown_depths(scene: SceneBatch | CachedScene) -> SceneBatch | CachedScene:
    return _with_depths(scene, torch.zeros_like(scene.all_views().masks)) if isinstance(scene, SceneBatch) else scene
