"""Sequences whose content is known, for stores that are made from them and for the check of data sets."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.preparation import prepare
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.errors import BadImage, DataError
from completesplat.geometry.cameras import Cameras, look_at

SIZE = 16
NUMBERS = (10, 13, 16, 19)


def smooth_image(seed: int, masked: bool, size: int = SIZE) -> MaskedImage:
    """Waves of colour, and a soft disc as the mask."""
    generator = torch.Generator().manual_seed(seed)
    phase = 6 * torch.rand(3, 2, 1, 1, generator=generator)
    y, x = torch.meshgrid(*[torch.linspace(0, 3, size)] * 2, indexing="ij")
    image = (127.5 * (1 + (x + phase[:, 0]).sin() * (y + phase[:, 1]).cos())).to(torch.uint8)
    disc = (255 * (1.5 - (x - 1.5).hypot(y - 1.5)).clamp(0, 1)).to(torch.uint8)[None]
    return MaskedImage(image, disc if masked else None)


def make_sequence(name: str, numbers: Sequence[int] = NUMBERS, masked: bool = True, **read: object) -> PosedSequence:
    """A camera on an arc around the origin; frames have these numbers."""
    seed, size, frames = sum(name.encode()), SIZE, len(numbers)
    angles = torch.linspace(0.1, 1.3, frames, dtype=torch.float64) + seed / 7
    eyes = torch.stack([angles.cos(), torch.full_like(angles, 0.3), angles.sin()], dim=-1)
    up = torch.tensor([0, 1, 0], dtype=torch.float64)
    intrinsics = torch.tensor([[size / 3, 0, size / 2], [0, size / 3.1, size / 2.2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(look_at(eyes, torch.zeros_like(up), up), intrinsics.repeat(frames, 1, 1), (size, size))
    ranges = torch.stack([angles / 3, angles * 3], dim=-1).float()
    return PosedSequence(name, tuple(numbers), cameras, ranges, partial(_read, name, seed, masked, **read))


def _read(
    name: str, seed: int, masked: bool, index: int, bad: Sequence[int] = (), log: list[tuple[str, int]] | None = None
) -> MaskedImage:
    if log is not None:
        log.append((name, index))
    if index in bad:
        raise BadImage("cannot be decoded", f"{name}/{index}.jpg")
    return smooth_image(seed + index, masked)


@dataclass
class ListedSource(SequenceSource):
    """Sequences made on the spot, with the numbers of their frames where they are not `NUMBERS`; some can fail."""

    listed_names: Sequence[str] | dict[str, tuple[int, ...]]
    masked: bool = True
    bad_frames: dict[str, list[int]] = field(default_factory=dict)  # indices
    failing: dict[str, BaseException] = field(default_factory=dict)  # raised when the sequence is read
    group_size: int = 1  # of a chunk
    content: str = "a"
    refused: list[DataError] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)
    changed: list[DataError] = field(default_factory=list)  # what differs from its checksum
    listed: int = 0
    was_read: list[str] = field(default_factory=list)
    images_read: list[tuple[str, int]] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        return list(self.listed_names)

    def read(self, name: str) -> PosedSequence:
        if name in self.failing:
            raise self.failing[name]
        self.was_read.append(name)
        numbers = self.listed_names[name] if isinstance(self.listed_names, dict) else NUMBERS
        return make_sequence(name, numbers, self.masked, bad=self.bad_frames.get(name, ()), log=self.images_read)

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        numbers = list(range(len(names)))
        return [numbers[start : start + self.group_size] for start in range(0, len(names), self.group_size)]

    def verify(self) -> list[DataError]:
        return self.changed

    def fingerprint(self) -> str:
        return self.content


def pack(source: ListedSource, out: Path, split: str = "train", settings: dict | None = None, **options: Any) -> Path:
    """Prepare a store of one split: two sequences in each shard, in this process."""
    quick = {"sequences_per_shard": 2, "workers": 1, "progress": False}
    return prepare({split: source}, {"image_size": SIZE} | (settings or {}), out, **quick | options)


def prepared(data: SceneDataModule, out: Path, **settings: Any) -> Path:
    """The packed store of a data module."""
    sources = {split: data.source(split) for split in ("train", "val", "test")}
    return prepare(sources, data.packed_settings(), out, **{"workers": 1, "progress": False, **settings})


def contents(folder: Path) -> dict[str, bytes]:
    """What the files of a folder and of those in it hold, by path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
