"""Sequences whose content is known, for stores that are made from them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.data.validation import BadImage, TooFewFrames
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, look_at

SIZE = 16


def smooth_image(seed: int, masked: bool, size: int = SIZE) -> MaskedImage:
    """Waves of colour, and a soft disc as the mask."""
    generator = torch.Generator().manual_seed(seed)
    phase = 6 * torch.rand(3, 2, 1, 1, generator=generator)
    y, x = torch.meshgrid(*[torch.linspace(0, 3, size)] * 2, indexing="ij")
    image = (127.5 * (1 + (x + phase[:, 0]).sin() * (y + phase[:, 1]).cos())).to(torch.uint8)
    disc = (255 * (1.5 - (x - 1.5).hypot(y - 1.5)).clamp(0, 1)).to(torch.uint8)[None]
    return MaskedImage(image, disc if masked else None)


def make_sequence(name: str, frames: int = 4, masked: bool = True, bad: tuple[int, ...] = ()) -> PosedSequence:
    """A camera on an arc around the origin; frames are numbered 10, 13, 16, ..."""
    seed, size = sum(name.encode()), SIZE
    angles = torch.linspace(0.1, 1.3, frames, dtype=torch.float64) + seed / 7
    eyes = torch.stack([angles.cos(), torch.full_like(angles, 0.3), angles.sin()], dim=-1)
    up = torch.tensor([0, 1, 0], dtype=torch.float64)
    intrinsics = torch.tensor([[size / 3, 0, size / 2], [0, size / 3.1, size / 2.2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(look_at(eyes, torch.zeros_like(up), up), intrinsics.repeat(frames, 1, 1), (size, size))
    ranges = torch.stack([angles / 3, angles * 3], dim=-1).float()
    read = partial(_read, name, seed, masked, bad)
    return PosedSequence(name, tuple(range(10, 10 + 3 * frames, 3)), cameras, ranges, read)


def _read(name: str, seed: int, masked: bool, bad: tuple[int, ...], index: int) -> MaskedImage:
    if index in bad:
        raise BadImage("cannot be decoded", f"{name}/{index}.jpg")
    return smooth_image(seed + index, masked)


@dataclass
class ListedSource(SequenceSource):
    """Sequences made on the spot; some can fail. The person at the keyboard has enough when `stop_after` are read."""

    names: list[str]
    frames: int = 4
    masked: bool = True
    bad_frames: dict[str, list[int]] = field(default_factory=dict)  # indices
    bad_sequences: list[str] = field(default_factory=list)
    stop_after: int | None = None
    group_size: int = 1  # of a chunk
    content: str = "a"
    refused: list[DataError] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)
    listed: int = 0
    was_read: list[str] = field(default_factory=list)

    def read(self, name: str) -> PosedSequence:
        if self.stop_after is not None and len(self.was_read) >= self.stop_after:
            raise KeyboardInterrupt
        self.was_read.append(name)
        if name in self.bad_sequences:
            raise TooFewFrames("1 frame", f"{name}.txt")
        return make_sequence(name, self.frames, self.masked, bad=tuple(self.bad_frames.get(name, ())))

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        numbers = list(range(len(names)))
        return [numbers[start : start + self.group_size] for start in range(0, len(names), self.group_size)]

    def fingerprint(self) -> str:
        return self.content


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}
