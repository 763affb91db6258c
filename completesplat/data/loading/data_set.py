"""Base class of all data sets: settings of reading, and the sequences and scenes of each split."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from jaxtyping import Float
from torch import Tensor

from completesplat.data.loading.hidden_modes import HiddenModeScenes
from completesplat.data.loading.scenes import EvaluationScenes, SceneStore
from completesplat.data.loading.training_statistics import TypicalCamera, mean_camera, mean_image
from completesplat.data.loading.view_selection import Choice
from completesplat.data.packed.manifest import Scalar, is_packed, settings_must_match
from completesplat.data.packed.source import PackedSource, local_root
from completesplat.data.sequences import PosedSequence, SequenceSource, first_names
from completesplat.data.tolerance import ErrorTolerance, OnBad
from completesplat.errors import CompleteSplatError, DataError, MissingFile, errors_at
from completesplat.quantities import Range, Share, Side
from completesplat.wording import counted

logger = logging.getLogger(__name__)


class SceneDataSet(ABC):
    """Scenes from a data set as published, or as prepared with `completesplat data prepare`.

    A data set implements the five abstract methods. What it reads is opened once for each split.

    Args:
        root: folder of the data set or of its prepared form, or the address of the prepared form (`packed.source`).
        mask_threshold: masks are binarized at this probability; None: they stay soft.
        background: grey value that replaces the background of images with a mask ("Objects only"); None: it stays.
        cache: keep decoded images in memory.
        on_bad: "skip" items that cannot be read (counted and reported), or "raise" the error.
        max_bad_fraction: share of an epoch's items that may be skipped; one always may, unless this is 0.
    """

    splits_share_sequences = False
    """Whether all splits have the same sequences on purpose, because each split has other frames of them."""

    def __init__(
        self,
        root: str,
        image_size: Side = 128,
        mask_threshold: Annotated[float, Range(1e-6, 1)] | None = None,
        background: Share | None = None,
        cache: bool = False,
        on_bad: OnBad = "skip",
        max_bad_fraction: Share = 0.1,
    ) -> None:
        super().__init__()
        self.root = local_root(root)
        self.image_size = image_size
        self.mask_threshold = mask_threshold
        self.background = background
        self.cache = cache
        self.tolerance = ErrorTolerance(on_bad, max_bad_fraction)
        self.tested_names: Sequence[str] | None = None
        """Names of the sequences that a test takes, those of a protocol's list; None: all."""
        self._sources: dict[str, SequenceSource] = {}
        self._stores: dict[str, SceneStore] = {}

    @abstractmethod
    def packed_settings(self) -> Mapping[str, Scalar]:
        """Return the settings that determine images, cameras and splits. Prepared data must have the same."""

    @abstractmethod
    def describe(self) -> Mapping[str, str | None]:
        """Return facts for results: "data_set", "crop", "protocol_views"; "subset" and "split" if there are lists."""

    @abstractmethod
    def open(self, split: str) -> Mapping[str, SequenceSource]:
        """Open the data set's own files. Return the sequences of this split, and of splits that are read with it.

        Raises:
            DataError: the files are missing or unreadable as a whole.
        """

    @abstractmethod
    def training_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Return reference and targets of a training scene."""

    @abstractmethod
    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return reference and targets of a scene of "val" or "test".

        Raises:
            DataError: the sequence lacks one of the frames.
        """

    def select_sequences(self, split: str, source: SequenceSource) -> SequenceSource:
        """Select the sequences of a split that are used. By default all."""
        return source

    def stackable(self, scenes: EvaluationScenes) -> bool:
        """Return whether all evaluation scenes have the same number of targets."""
        return scenes.stackable()

    def hidden_modes(self, views: int, spread_views: int) -> HiddenModeScenes:
        """Return all test scenes. Targets are up to `views` views that show the modes best, and evenly spread ones.

        Raises:
            CompleteSplatError: the alternatives for what the reference image hides are not known.
        """
        known = "toy objects, or data render hidden=modes"
        raise CompleteSplatError(f"evaluation=hidden_modes needs data whose hidden parts are known: {known}")

    def source(self, split: str) -> SequenceSource:
        """Return the sequences of a split ("train", "val" or "test") from the data set's own or prepared files.

        Raises:
            DataError: files are missing, malformed or prepared with other settings, or broken if `on_bad` is "raise".
        """
        if split not in self._sources:
            if is_packed(self.root):
                settings_must_match(self.root, self.packed_settings())
                self._sources[split] = PackedSource(self.root, split, self.image_size)
            else:
                self._sources.update(self.open(split))
            if split == "test" and self.tested_names is not None:
                self._take_only(self.tested_names, self._sources[split])
        source = self._sources[split]
        for error in source.refused:
            self.tolerance.check(error)
        return source

    def _take_only(self, names: Sequence[str], source: SequenceSource) -> None:
        """Leave out the sequences that are not listed; raise MissingFile if one that is listed is not there."""
        missing = sorted(set(names).difference(source.names))
        if missing:
            count = f"{len(missing)} of the {counted(len(names), 'scene')} of the protocol's list"
            raise MissingFile(f"lacks {count}: {first_names(missing)}", str(self.root))
        source.names = sorted(set(names))

    def store(self, split: str) -> SceneStore:
        """Return the scenes of a split, which must have sequences that can be used. Errors as in `source`."""
        if split not in self._stores:
            source = self.source(split)
            selected = self.select_sequences(split, source)
            if not selected.names:
                raise DataError(f"no {split} sequences that can be used", str(self.root))
            if source.refused:
                logger.warning("%d annotations cannot be used; the first: %s", len(source.refused), source.refused[0])
            self._stores[split] = SceneStore(selected, self.mask_threshold, self.cache, self.background)
        return self._stores[split]

    def typical_camera(self) -> TypicalCamera:
        """Return the mean camera of the training images."""
        with errors_at(file=self.root):
            return mean_camera(self.store("train"))

    def mean_image(self) -> Float[Tensor, "3 height width"] | None:
        """Return the mean of the images that `typical_camera` averages, a baseline that ignores the input, if any."""
        return mean_image(self.store("train"), self.image_size) if self.source("train").names else None
