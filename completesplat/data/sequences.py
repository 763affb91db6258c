"""Posed image sequences: the common form of all data sets, independent of their files and conventions."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras


class MaskedImage(NamedTuple):
    """Square image (sRGB) and its foreground probability (0 to 255), if the data set has one."""

    image: UInt8[Tensor, "3 size size"]
    mask: UInt8[Tensor, "1 size size"] | None


@dataclass(frozen=True)
class PosedSequence:
    """Frames of one video, cropped to squares and at the common scale.

    Attributes:
        frames: frame numbers in the data set, in order.
        cameras: [view], float64, of the square images; the world is the sequence's own.
        depth_ranges: (near, far) for each frame as the reference, float32, in units of the cameras.
        read: index of a frame (not its number) -> its image; a DataError if it cannot be read.
        read_depth: index of a frame -> depth along the optical axis in units of the cameras, 0 where it is unknown; a
            DataError if it cannot be read; None: there is no depth.
        points: points of a reconstruction in the cameras' world and units, if the data set has them.
        scale: units of the cameras in one unit of the data set's own files, where it is known.
        origin: the cameras' origin in the coordinates and units of these files.
        photos: names of the frames' files, where they are known.
    """

    name: str
    frames: tuple[int, ...]
    cameras: Cameras
    depth_ranges: Float[Tensor, "view 2"]
    read: Callable[[int], MaskedImage]
    read_depth: Callable[[int], Float[Tensor, "1 size size"]] | None = None
    points: Float[Tensor, "n 3"] | None = None
    scale: float = 1.0
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    photos: tuple[str, ...] = ()


class SequenceSource(ABC):
    """Sequences of one split, in any form of storage.

    Attributes:
        names: names of the sequences that can be read, as far as listing them can tell.
        refused: errors that were found when the sequences were listed.
        left_out: names of intact sequences that are left out, by reason.
        listed: number of sequences that the data set has for this split, usable or not.
    """

    def __init__(self, names: list[str], listed: int, refused: list[DataError], left_out: dict[str, list[str]]) -> None:
        self.names = names
        self.listed = listed
        self.refused = refused
        self.left_out = left_out

    @abstractmethod
    def read(self, name: str) -> PosedSequence:
        """Read a sequence's cameras, or raise a DataError. `PosedSequence.read` reads its images later."""

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """Return groups of indices into `names` that are best read one after the other, by default one group."""
        return [list(range(len(names)))]

    def verify(self) -> Sequence[DataError]:
        """Return the files that differ from their checksums. By default there are no checksums."""
        return []

    @abstractmethod
    def fingerprint(self) -> str:
        """Return a SHA-256 (hexadecimal) of the sequences' sources, which changes with the data."""


def first_names(names: Sequence[str], most: int = 5) -> str:
    """Return the first few names for a message."""
    listed = [*names[:most], "..."] if len(names) > most else names
    return ", ".join(listed)


def spread_places(count: int, most: int | None) -> list[int]:
    """Return at most `most` of `count` indices, the middles of equal parts, or all if `most` is None."""
    if most is None or most >= count:
        return list(range(count))
    return [(2 * part + 1) * count // (2 * most) for part in range(most)]
