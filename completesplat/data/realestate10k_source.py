"""RealEstate10K clips as posed sequences: cropped, scaled, with the depth range of the configuration."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from completesplat.data.checks import at
from completesplat.data.realestate10k_chunks import ChunkedClips
from completesplat.data.realestate10k_clips import Clip
from completesplat.data.realestate10k_text import TextClips
from completesplat.data.sequences import Picture, PosedSequence
from completesplat.data.transforms import Square, principal_square
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.tensors import stack

CROPS = ("center", "principal")

Clips = TextClips | ChunkedClips


@dataclass(frozen=True)
class Framing:
    """How pictures and cameras are made from files.

    Attributes:
        image_size: side of the square pictures.
        crop: "center": the largest central square; "principal": the largest square around the principal point.
        scale: all lengths are multiplied by this, near and far included.
        near, far: the depth range of every scene, in the clips' own units.
    """

    image_size: int
    crop: str
    scale: float
    near: float
    far: float


def open_clips(folder: Path) -> Clips:
    """The clips of a split's folder, in whichever form they are: with an `index.json`, in chunks, else in texts.

    Raises:
        DataError: neither is there.
    """
    if (folder / "index.json").is_file():
        return ChunkedClips(folder)
    if folder.is_dir() and any(folder.glob("*.txt")):
        return TextClips(folder)
    raise DataError("no RealEstate10K clips there: neither index.json (with *.torch) nor *.txt", str(folder))


class RE10KSource:
    """Some clips of one folder; see `SequenceSource`. The clips may be shared by several sources."""

    def __init__(self, clips: Clips, names: list[str], framing: Framing) -> None:
        self.names = names
        self.refused: list[DataError] = clips.refused
        self.left_out = {"frames are missing": clips.missing} if clips.missing else {}
        self.listed = len(names) + len(clips.missing)
        self.framing = framing
        self._clips = clips

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """The clips of one chunk each."""
        return self._clips.chunks(names)

    def fingerprint(self) -> str:
        """SHA-256 of what lists the clips; pictures are not looked at."""
        return self._clips.fingerprint()

    def read(self, name: str) -> PosedSequence:
        """One clip: its cameras now, its pictures when asked for.

        Raises:
            DataError: it is missing, unreadable or malformed.
        """
        clip, framing = self._clips.clip(name), self.framing
        count = len(clip.timestamps)
        squares = [_square(clip, framing.crop, frame) for frame in range(count)]
        cameras = _cropped(clip.cameras, squares, framing.image_size)
        cameras = cameras.scale_world(torch.tensor(framing.scale, dtype=torch.float64))
        depth_range = torch.tensor([framing.near * framing.scale, framing.far * framing.scale])
        read = partial(_read, clip, squares, framing.image_size)
        return PosedSequence(name, tuple(range(count)), cameras, depth_range.repeat(count, 1), read)


def _square(clip: Clip, crop: str, frame: int) -> Square:
    height, width = clip.cameras.image_size
    with at(clip.source, clip.key, frame):
        x, y = clip.cameras.intrinsics[frame, :2, 2].tolist() if crop == "principal" else (width / 2, height / 2)
        return principal_square((x, y), (height, width))


def _cropped(cameras: Cameras, squares: list[Square], size: int) -> Cameras:
    if len(set(squares)) == 1:
        return crop_resize(cameras, *squares[0], size)
    return stack([crop_resize(cameras[i], *square, size) for i, square in enumerate(squares)])


def _read(clip: Clip, squares: list[Square], size: int, index: int) -> Picture:
    with at(clip.source, clip.key, index):
        return Picture(clip.read(index, squares[index], size), None)
