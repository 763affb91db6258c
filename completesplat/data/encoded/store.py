"""Reading an encoded store: opened by its manifest, memory-mapped, a row copied when it is asked for."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.checks import MissingFile
from completesplat.data.encoded.arrays import open_array
from completesplat.data.encoded.manifest import Sequence, is_encoded, read_manifest
from completesplat.data.prepared.manifest import Scalar, differences
from completesplat.data.sequences import SequenceSource
from completesplat.errors import DataError
from completesplat.scene import EncodedScene


class EncodedStore:
    """The encoded pictures of a training set.

    Attributes:
        scale: 1 / standard deviation of a latent drawn from the posteriors, over all elements of all stored frames.
        arrays: memory-mapped "mean", "log_variance" and "condition", one row for each picture.

    Raises:
        DataError: no finished store, or one that is damaged.
    """

    def __init__(self, folder: Path) -> None:
        if not is_encoded(folder):
            raise MissingFile(
                "no finished store of encoded pictures: completesplat data latents makes one", str(folder)
            )
        self.folder = folder
        self.manifest = read_manifest(folder)
        self.origin = self.manifest.origin
        self.scale = self.manifest.scale
        self.arrays = {name: open_array(folder, array) for name, array in self.manifest.arrays.items()}
        self.sequences = {sequence.name: sequence for sequence in self.manifest.sequences}

    @property
    def latent_shape(self) -> tuple[int, ...]:
        """Channels, height and width."""
        return self.manifest.arrays["mean"].shape[1:]

    @property
    def holds_pictures(self) -> bool:
        """Whether the conditions are pictures rather than features."""
        return self.origin.conditioning is None

    def scene(self, name: str, frame: int) -> EncodedScene:
        """One encoded frame, without batch axis; features as they were stored, in float32.

        Args:
            frame: place in the sequence.

        Raises:
            DataError: it is not in the store.
        """
        row = self._row(self.sequences[name], frame)
        mean, log_variance = self._floats("mean", row), self._floats("log_variance", row)
        if self.holds_pictures:
            # The same division as of pictures that are read, bit by bit.
            share = np.divide(self.arrays["condition"][row], 255, dtype=np.float32)
            condition = torch.from_numpy(np.asarray(share))
        else:
            condition = self._floats("condition", row)
        return EncodedScene(mean, log_variance, condition, torch.tensor(frame), name)

    def must_belong_to(self, source: SequenceSource, settings: dict[str, Scalar]) -> None:
        """Refuse a store that was made from other pictures than `source` gives with these settings.

        Raises:
            DataError: another fingerprint, other settings, or other sequences.
        """
        differing = differences(self.origin.settings, settings)
        if differing:
            raise DataError(f"encoded with {differing}: set these as they were, or encode again", str(self.folder))
        self.must_be_of(source)

    def must_be_of(self, source: SequenceSource) -> None:
        """Refuse a store that was made from another data set.

        Raises:
            DataError: another fingerprint, or other sequences.
        """
        if self.origin.data != source.fingerprint() or list(self.sequences) != source.names:
            raise DataError("made from other data than the training set now: encode it again", str(self.folder))

    def missing(self, name: str, frame: int | None = None) -> DataError:
        """What to raise where a sequence, or a frame of it, is asked for and not there."""
        what = "its pictures" if frame is None else f"its picture {frame + 1}"
        return DataError(f"{what} could not be read when the training set was encoded", str(self.folder), name)

    def _row(self, sequence: Sequence, frame: int) -> int:
        place = int(np.searchsorted(sequence.stored, frame))
        if place == len(sequence.stored) or sequence.stored[place] != frame:
            raise self.missing(sequence.name, frame)
        return sequence.first + place

    def _floats(self, array: str, row: int) -> Float[Tensor, "_ _ _"]:
        return torch.from_numpy(np.array(self.arrays[array][row], dtype=np.float32))

    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes map the files themselves; a pickled array would hold all of it.
        return EncodedStore, (self.folder,)
