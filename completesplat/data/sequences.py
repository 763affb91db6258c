"""Sequences of pictures with cameras: what a data set is, once its own files and conventions are behind it."""

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras

SPLITS = ("train", "val", "test")


class Picture(NamedTuple):
    """One square picture (sRGB) and its foreground probability (0 to 255), if the data set has one."""

    image: UInt8[Tensor, "3 size size"]
    mask: UInt8[Tensor, "1 size size"] | None


@dataclass(frozen=True)
class PosedSequence:
    """The frames of one video, cropped to squares and at the common scale.

    Attributes:
        frames: the numbers that the data set gives them, in order.
        cameras: [view], float64, of the square pictures; the world is the sequence's own.
        depth_ranges: (near, far) with each of the frames as the reference, float32, in units of the cameras.
        read: index of a frame (not its number) -> its picture. Raises `DataError` if it cannot be read.
        read_depth: index of a frame -> depth along the optical axis in units of the cameras, 0 where it is unknown;
            None: there is no depth. Raises `DataError` if it cannot be read.
    """

    name: str
    frames: tuple[int, ...]
    cameras: Cameras
    depth_ranges: Float[Tensor, "view 2"]
    read: Callable[[int], Picture]
    read_depth: Callable[[int], Float[Tensor, "1 size size"]] | None = None


@runtime_checkable
class SequenceSource(Protocol):
    """The sequences of one split, wherever they lie.

    Attributes:
        names: of the sequences that can be read, as far as listing them showed.
        refused: what listing them found broken.
        left_out: names that were left out although nothing is broken, by reason.
        listed: how many sequences the data set has for this split, usable or not.
    """

    names: list[str]
    refused: list[DataError]
    left_out: dict[str, list[str]]
    listed: int

    def read(self, name: str) -> PosedSequence:
        """One sequence: its cameras now, its pictures when `PosedSequence.read` is called. `DataError` if unusable."""
        ...

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """Indices into `names` of the sequences that are best read one after the other; by default any order does."""
        return [list(range(len(names)))]

    def verify(self) -> Sequence[DataError]:
        """Return the files that differ from their checksums; by default there are no checksums."""
        return []

    def fingerprint(self) -> str:
        """SHA-256 (hexadecimal) of what the sequences are made from: another one means other data."""
        ...


def shared_names(splits: Mapping[str, Collection[str]]) -> dict[str, list[str]]:
    """Return the names that two splits share, by pair: "train and val". Pairs that share nothing are left out."""
    pairs = {f"{one} and {other}": sorted({*splits[one]} & {*splits[other]}) for one, other in combinations(splits, 2)}
    return {pair: names for pair, names in pairs.items() if names}


def overlaps(shared: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a sentence for each pair of `shared_names`."""
    return [f"{len(names)} sequences are in both {pair}: {shortened(names)}" for pair, names in shared.items()]


def shortened(names: Sequence[str], most: int = 5) -> str:
    """The first few names, for a message."""
    return ", ".join([*names[:most], *(["..."] if len(names) > most else [])])


def spread_places(count: int, most: int | None) -> list[int]:
    """At most `most` of `count` places: the middles of equal parts; None: all."""
    if most is None or most >= count:
        return list(range(count))
    return [(2 * part + 1) * count // (2 * most) for part in range(most)]


def split_by_hash(names: Sequence[str], fraction: float, seed: int) -> tuple[list[str], list[str]]:
    """Training and held-out sequences, in the given order.

    A sequence's side depends on its name and the seed only, so that it stays where it is when others come; only where
    none would be held out is it the one with the smallest hash.
    """
    position = {name: int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:8]) / 2**64 for name in names}
    held_out = {name for name in names if position[name] < fraction}
    held_out = held_out or set(sorted(names, key=position.__getitem__)[:1])
    return [name for name in names if name not in held_out], [name for name in names if name in held_out]
