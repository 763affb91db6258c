"""Datasets of scenes made from sequences, with views in the reference's frame. Read errors are returned, not raised."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from completesplat.data.loading.augmentation import Augmentation
from completesplat.data.loading.distributed import processes
from completesplat.data.loading.view_selection import Choice, item_generator
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.errors import CompleteSplatError, DataError, TooFewFrames, refused_to
from completesplat.scene import CachedScene, SceneBatch, Views
from completesplat.tensors import stack

ATTEMPTS = 10  # Number of items that are tried before none is returned.


class LoadedScenes(NamedTuple):
    """A scene or a batch of scenes, and the errors of those that could not be read.

    `refused_depths` are the errors of scenes whose true depth exists but could not be read.
    """

    scenes: SceneBatch | CachedScene | None
    refused: tuple[DataError, ...]
    refused_depths: tuple[DataError, ...] = ()


@dataclass(eq=False)
class SceneStore:
    """Scenes from the sequences of a source, in the order of its names.

    Args:
        mask_threshold: masks are 1 where the foreground probability reaches it, else 0; None keeps soft masks.
        cache: keep decoded images (uint8) in memory after their first use.
        background: grey value (0 to 1) that replaces the background of images with a mask; None keeps it.
    """

    source: SequenceSource
    mask_threshold: float | None = None
    cache: bool = False
    background: float | None = None

    def __post_init__(self) -> None:
        self.names = self.source.names
        self._cache: dict[tuple[str, int], MaskedImage] | None = {} if self.cache else None

    def scene(self, sequence: PosedSequence, reference: int, targets: Sequence[int]) -> SceneBatch:
        """Return the scene of the views with these indices, in the reference camera's coordinates."""
        views = [reference, *targets]
        pairs = [self._read(sequence, view) for view in views]
        images = _as_floats([pair.image for pair in pairs])
        masks = self._masks(pairs)
        cameras = sequence.cameras[views].relative_to(sequence.cameras[reference]).to(torch.float32)
        loaded = Views(images, cameras, masks)
        depth_range = sequence.depth_ranges[reference]
        frame = torch.tensor(reference)
        return SceneBatch(loaded[0], loaded[1:], depth_range, torch.ones_like(masks[0]), frame, sequence.name)

    def image(self, sequence: PosedSequence, view: int) -> UInt8[Tensor, "3 height width"]:
        """Return one image of a sequence."""
        return self._read(sequence, view).image

    def _read(self, sequence: PosedSequence, view: int) -> MaskedImage:
        key = sequence.name, view
        if self._cache is None:
            return self._on_background(sequence.read(view))
        if key not in self._cache:
            self._cache[key] = self._on_background(sequence.read(view))
        return self._cache[key]

    def _masks(self, pairs: Sequence[MaskedImage]) -> Float[Tensor, "view 1 size size"]:
        everywhere = torch.full_like(pairs[0].image[:1], 255)
        stored = [everywhere if pair.mask is None else pair.mask for pair in pairs]
        masks = _as_floats(stored)
        return masks if self.mask_threshold is None else (masks >= self.mask_threshold).float()

    def _on_background(self, pair: MaskedImage) -> MaskedImage:
        if self.background is None or pair.mask is None:
            return pair
        mask = self._masks([pair])[0].numpy()
        mixed = np.rint(pair.image.numpy() * mask + 255 * self.background * (1 - mask))
        return pair._replace(image=torch.from_numpy(mixed.astype(np.uint8)))


def _as_floats(images: Sequence[UInt8[Tensor, "_ size size"]]) -> Float[Tensor, "view _ size size"]:
    # NumPy, because torch would start threads for this little work, and they would block other processes' cores.
    return torch.from_numpy(np.divide([image.numpy() for image in images], 255, dtype=np.float32))


@dataclass(eq=False)
class TrainingScenes(Dataset[LoadedScenes]):
    """Dataset of scenes with random views. A key is (epoch, index), see `EpochSampler`.

    An item that cannot be read is replaced by another one. All random choices depend on (seed, epoch, index) only.

    Args:
        choose: (number of frames, epoch, random generator) -> views.
        targets: number of targets of a scene, which can all be different in a usable sequence.
        references: number of items of each sequence in one epoch.
    """

    store: SceneStore
    choose: Callable[[int, int, np.random.Generator], Choice]
    targets: int
    augmentation: Augmentation
    references: int
    seed: int

    def __len__(self) -> int:
        return len(self.store.names) * self.references

    def __getitem__(self, key: tuple[int, int]) -> LoadedScenes:
        epoch, index = key
        rng = item_generator(self.seed, epoch, index)
        refused: list[DataError] = []
        for _ in range(ATTEMPTS):
            name = self.store.names[index // self.references]
            with refused_to(refused.append, sequence=name):
                return LoadedScenes(self.draw(name, epoch, rng), tuple(refused))
            index = int(rng.integers(len(self)))
        return LoadedScenes(None, tuple(refused))

    def draw(self, name: str, epoch: int, rng: np.random.Generator) -> SceneBatch | CachedScene:
        """Return a scene of random views of the sequence `name`."""
        sequence = self.store.source.read(name)
        reference, targets = self.views(len(sequence.frames), epoch, rng)
        return self.augmentation(self.store.scene(sequence, reference, targets), rng)

    def views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Choose the views of a sequence.

        Raises:
            TooFewFrames: its targets cannot all be different.
        """
        if frames <= self.targets:
            raise TooFewFrames(f"{frames} frames, data.targets={self.targets} needs {self.targets + 1}")
        return self.choose(frames, epoch, rng)

    def groups(self) -> list[list[int]]:
        """Return groups of item indices. The items of a group are best loaded one after the other."""
        groups = []
        for sequences in self.store.source.groups(self.store.names):
            firsts = [sequence * self.references for sequence in sequences]
            groups.append([first + offset for first in firsts for offset in range(self.references)])
        return groups

    def check(self, batch_size: int) -> None:
        """Check that scenes and batches can be made.

        Raises:
            CompleteSplatError: an epoch has fewer scenes than a batch, or sequences can be read, but none has enough
                frames.
        """
        names = self.store.names
        if batch_size > len(self):
            scenes = f"{len(self)} scenes (data.references_per_sequence of each of {len(names)} sequences)"
            raise CompleteSplatError(f"data.batch_size={batch_size}: an epoch has {scenes}; lower it")
        most = 0
        for name in names:
            with suppress(DataError):
                most = max(most, len(self.store.source.read(name).frames))
            if most > self.targets:
                return
        # Else no sequence can be read, or none has two frames. Loading tells why, for each sequence.
        if most > 1:
            message = f"a scene needs {self.targets + 1} frames, training sequences have at most {most} frames"
            raise CompleteSplatError(f"data.targets={self.targets}: {message}")


@dataclass(eq=False)
class EvaluationScenes(Dataset[LoadedScenes]):
    """Dataset of evaluation scenes, one for each sequence.

    Args:
        choose: sequence -> views; it raises a DataError if the sequence lacks one of them.
        names: sequences to evaluate.
        low_resolution: store of the smaller images that the model takes; None: it takes the images of `store`.
        depths: also read the true depth if the data set has it.
    """

    store: SceneStore
    choose: Callable[[PosedSequence], Choice]
    names: Sequence[str]
    low_resolution: SceneStore | None = None
    depths: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def share(self, batch_size: int) -> "EvaluationScenes":
        """Return this process's share, in whole batches, so that batches are the same with any number of processes.

        A process for which no batch is left takes the first scene again, because all processes gather their scores.
        """
        rank, count = processes()
        starts = range(rank * batch_size, len(self.names), count * batch_size)
        local = [name for start in starts for name in self.names[start : start + batch_size]]
        return replace(self, names=local or self.names[:1])

    def __getitem__(self, index: int) -> LoadedScenes:
        name = self.names[index]
        refused: list[DataError] = []
        refused_depths: list[DataError] = []
        with refused_to(refused.append):
            sequence = self.store.source.read(name)
            reference, targets = self.choose(sequence)
            scene = self.store.scene(sequence, reference, targets)
            if self.low_resolution is not None:
                smaller = self.low_resolution.source.read(name)
                scene = replace(scene, low_resolution=self.low_resolution.scene(smaller, reference, targets))
            if self.depths:
                with refused_to(refused_depths.append):
                    scene = with_true_depths(scene, sequence, reference, targets)
            return LoadedScenes(scene, (), tuple(refused_depths))
        return LoadedScenes(None, tuple(refused))

    def stackable(self) -> bool:
        """Return whether all scenes that can be read have the same number of targets."""
        counts = set()
        for name in self.names:
            with suppress(DataError):
                counts.add(len(self.choose(self.store.source.read(name))[1]))
        return len(counts) <= 1


def with_true_depths(scene: SceneBatch, sequence: PosedSequence, reference: int, targets: list[int]) -> SceneBatch:
    """Return a scene with the true depth of its views, if the data set has it."""
    if sequence.read_depth is None:
        return scene
    return _with_depths(scene, torch.stack([sequence.read_depth(view) for view in (reference, *targets)]))


def _with_depths(scene: SceneBatch, depths: Float[Tensor, "view 1 height width"]) -> SceneBatch:
    reference = replace(scene.reference, depths=depths[0])
    targets = replace(scene.targets, depths=depths[1:])
    return replace(scene, reference=reference, targets=targets)


def _with_any_depths(scene: SceneBatch | CachedScene) -> SceneBatch | CachedScene:
    if isinstance(scene, SceneBatch) and scene.reference.depths is None:
        return _with_depths(scene, torch.zeros_like(scene.all_views().masks))
    return scene


def collate(items: Sequence[LoadedScenes]) -> LoadedScenes:
    """Stack the scenes that could be read. If only some have depths, those of the remaining ones are 0 (unknown)."""
    scenes = [item.scenes for item in items if item.scenes is not None]
    unknown = [isinstance(scene, SceneBatch) and scene.reference.depths is None for scene in scenes]
    if any(unknown) and not all(unknown):
        scenes = [_with_any_depths(scene) for scene in scenes]
    refused = tuple(error for item in items for error in item.refused)
    refused_depths = tuple(error for item in items for error in item.refused_depths)
    return LoadedScenes(stack(scenes) if scenes else None, refused, refused_depths)
