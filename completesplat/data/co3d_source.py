"""CO3D sequences as posed sequences: cropped, at the common scale, with a depth range around the object."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.checks import BadCamera, at
from completesplat.data.co3d_annotations import CO3DFrame
from completesplat.data.co3d_category import SplitMembers
from completesplat.data.co3d_depth import square_depth
from completesplat.data.co3d_placement import object_placement
from completesplat.data.sequences import Picture, PosedSequence
from completesplat.data.transforms import Square, principal_square, read_square
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, crop_resize, transform_points
from completesplat.tensors import stack

# The object's half size (see `Placement`) after scaling (Splatter Image: 1.2 * 0.95 / 2).
OBJECT_HALF_SIZE = 0.57
SMALLEST_NEAR = 0.1
# Cameras that stay within this share of their distance to the object show nothing but one view of it.
SMALLEST_BASELINE = 0.01


@dataclass(frozen=True)
class Framing:
    """How pictures and cameras are made from files.

    Attributes:
        image_size: side of the square pictures.
        depth_before, depth_after: the depth range reaches this far in front of and behind the object's centre.
    """

    image_size: int
    depth_before: float
    depth_after: float


class CO3DSource:
    """The sequences of one split; see `SequenceSource`."""

    def __init__(
        self, members: SplitMembers, framing: Framing, files: Sequence[Path], refused: list[DataError]
    ) -> None:
        self.names = sorted(members.frames)
        self.left_out = members.left_out
        self.listed = members.listed
        self.refused = refused
        self.framing = framing
        self._frames = members.frames
        self._captured = members.captured
        self._point_clouds = members.point_clouds
        self._files = files
        self._sequences: dict[str, PosedSequence] = {}

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """All in one: every picture is a file of its own."""
        return [list(range(len(names)))]

    def fingerprint(self) -> str:
        """SHA-256 of the annotations; pictures are not looked at."""
        digest = hashlib.sha256()
        for file in self._files:
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()

    def read(self, name: str) -> PosedSequence:
        """One sequence; its cameras are made on first use.

        Raises:
            DataError: nothing tells where the object is, or the cameras do not move.
        """
        if name not in self._sequences:
            with at(sequence=name):
                self._sequences[name] = self._make(name)
        return self._sequences[name]

    def _make(self, name: str) -> PosedSequence:
        frames, size = self._frames[name], self.framing.image_size
        placement = object_placement(self._point_clouds[name], frames, self._captured[name])
        factor = OBJECT_HALF_SIZE / placement.half_size
        cameras = stack([_cropped(frame, size) for frame in frames])
        cameras = cameras.scale_world(torch.tensor(factor, dtype=torch.float64))
        depths = transform_points(cameras.world_to_camera, factor * placement.center[None])[..., 0, 2]
        baseline = (cameras.centers - cameras.centers[0]).norm(dim=-1).max()
        if not baseline > SMALLEST_BASELINE * depths.abs().mean():
            raise BadCamera("the cameras do not move", str(self._files[0]))
        return PosedSequence(
            name,
            tuple(frame.number for frame in frames),
            cameras,
            self._depth_ranges(depths).to(torch.float32),
            partial(_read, name, frames, size),
            partial(_read_depth, name, frames, size, factor) if any(frame.depth for frame in frames) else None,
        )

    def _depth_ranges(self, depths: Float[Tensor, " view"]) -> Float[Tensor, "view 2"]:
        near = (depths - self.framing.depth_before).clamp(min=SMALLEST_NEAR)
        # An object behind the camera (a broken pose) still gets a range of positive length.
        return torch.stack([near, torch.maximum(depths, near) + self.framing.depth_after], dim=-1)


def _cropped(frame: CO3DFrame, size: int) -> Cameras:
    square = _square(frame)
    return crop_resize(frame.camera, square.left, square.top, square.side, size)


def _square(frame: CO3DFrame) -> Square:
    x, y = frame.camera.intrinsics[:2, 2].tolist()
    return principal_square((x, y), frame.camera.image_size)


def _read(name: str, frames: list[CO3DFrame], size: int, index: int) -> Picture:
    frame = frames[index]
    square, image_size = _square(frame), frame.camera.image_size
    with at(sequence=name, frame=frame.number):
        image = read_square(frame.image, image_size, square, size, "RGB")
        return Picture(image, read_square(frame.mask, image_size, square, size, "L"))


def _read_depth(name: str, frames: list[CO3DFrame], size: int, factor: float, index: int) -> Float[Tensor, "1 _ _"]:
    with at(sequence=name):
        return square_depth(frames[index], _square(frames[index]), size, factor)
