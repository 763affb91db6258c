"""Sources of synthetic sequences with stated faults, in a module of their own so that other processes find them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.data.validation import BadAnnotation, BadImage
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, pinhole

SIZE = 4


@dataclass
class Source:
    """A split whose sequences have these frames.

    Attributes:
        broken_images, broken_sequences: (name, frame) and names that are refused when they are read.
        bugs: names whose reading fails for a reason that is no refusal.
        at_once: how many sequences lie together.
        log: a file to which every image that is read is appended.
    """

    frames: dict[str, tuple[int, ...]]
    broken_images: set[tuple[str, int]] = field(default_factory=set)
    broken_sequences: set[str] = field(default_factory=set)
    bugs: set[str] = field(default_factory=set)
    refused: list[DataError] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)
    listed: int = 0
    at_once: int = 2
    log: Path | None = None

    @property
    def names(self) -> list[str]:
        return list(self.frames)

    def read(self, name: str) -> PosedSequence:
        if name in self.bugs:
            raise ZeroDivisionError("a mistake in the reader")
        if name in self.broken_sequences:
            raise BadAnnotation("no camera", f"{name}.json")
        frames = self.frames[name]
        cameras = Cameras(
            torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1),
            pinhole(60, SIZE).double().repeat(len(frames), 1, 1),
            (SIZE, SIZE),
        )
        depth_ranges = torch.tensor([[1.0, 2.0]]).repeat(len(frames), 1)
        return PosedSequence(name, frames, cameras, depth_ranges, partial(self._image, name))

    def _image(self, name: str, index: int) -> MaskedImage:
        frame = self.frames[name][index]
        if self.log is not None:
            with self.log.open("a") as log:
                log.write(f"{name} {frame}\n")
        if (name, frame) in self.broken_images:
            raise BadImage("truncated", f"{name}/{frame}.jpg")
        return MaskedImage(torch.full((3, SIZE, SIZE), frame % 256, dtype=torch.uint8), None)

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        # The last come first: the order of reading need not be that of the names.
        starts = range(0, len(names), self.at_once)
        return [list(range(start, min(start + self.at_once, len(names)))) for start in starts][::-1]

    def verify(self) -> list[DataError]:
        return []

    def fingerprint(self) -> str:
        return "0" * 64


@dataclass
class Prepared(Source):
    """A split with checksums."""

    changed: list[DataError] = field(default_factory=list)

    def verify(self) -> list[DataError]:
        return self.changed
