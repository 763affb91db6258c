"""CO3D sequences as posed sequences: cropped, scaled to a common object size, with a depth range around the object."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.co3d.annotations import CO3DFrame
from completesplat.data.co3d.category import SplitMembers
from completesplat.data.co3d.depth_maps import read_depth
from completesplat.data.placement import (
    Axes,
    ObjectFraming,
    Placement,
    from_cameras,
    from_points,
    placed_sequence,
    square_of,
    upright_axes,
)
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.data.validation import read_points
from completesplat.errors import BadImage, DataError, errors_at
from completesplat.geometry.cameras import pixel_centers, unproject
from completesplat.photo.crop import Square
from completesplat.photo.files import decode_image

DEPTH_MAPS = 8
FOREGROUND = 128  # smallest mask value, of 255


def square_depth(frame: CO3DFrame, square: Square, size: int, factor: float) -> Float[Tensor, "1 size size"]:
    """Return depth along the optical axis at the pixel centres of the square image, 0 where it is unknown.

    Sampling is nearest-neighbour, because a mean across an edge is the depth of no surface. The depth map may differ in
    size from its image. `factor` converts the sequence's units to the common scale.

    Raises:
        DataError: the depth map cannot be read.
    """
    if frame.depth is None:
        return torch.zeros(1, size, size)
    with errors_at(frame=frame.number):
        depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
    places = []
    for count, side, start in zip(depth.shape, frame.camera.image_size, (square.top, square.left), strict=True):
        centers = start + (torch.arange(size, dtype=torch.float64) + 0.5) * square.side / size
        places.append((centers * count / side).long().clamp(0, count - 1))
    rows, columns = places
    return factor * depth[rows[:, None], columns][None]


def object_placement(point_cloud: Path | None, frames: Sequence[CO3DFrame], captured: Sequence[CO3DFrame]) -> Placement:
    """Locate the object by the point cloud, else by the frames' depth maps, else by their cameras.

    The axes come from `captured`, all frames of the sequence.

    Raises:
        DataError: the point cloud, a depth map or a mask is missing or unreadable.
        BadPlacement: as `from_points` and `from_cameras`.
    """
    axes = upright_axes([frame.camera for frame in captured])
    if point_cloud is not None:
        with errors_at(point_cloud):
            return from_points(read_points(point_cloud), axes, "the point cloud")
    with_depth = [frame for frame in frames if frame.depth is not None]
    return from_depth_maps(with_depth, axes) if with_depth else from_cameras([frame.camera for frame in frames])


def from_depth_maps(frames: Sequence[CO3DFrame], axes: Axes) -> Placement:
    """Place the object by the foreground points of up to 8 evenly spaced depth maps, as with a point cloud.

    The 99 % and 1 % quantiles replace the largest and smallest values, because depth maps have outliers.
    """
    count = min(len(frames), DEPTH_MAPS)
    points = []
    for frame in (frames[i * len(frames) // count] for i in range(count)):
        with errors_at(frame=frame.number):
            points.append(_foreground(frame))
    return from_points(np.concatenate(points), axes, "the depth maps' foreground", quantile=0.99)


def _foreground(frame: CO3DFrame) -> np.ndarray:
    """Return the world points [n 3] of a depth map's foreground. The map may be smaller than the image."""
    assert frame.depth is not None
    depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
    mask = decode_image(frame.mask, str(frame.mask), "L", frame.camera.image_size)
    height, width = depth.shape
    known = (depth > 0) & torch.from_numpy(np.asarray(mask.resize((width, height))) >= FOREGROUND)
    ratio = torch.tensor([frame.camera.image_size[1] / width, frame.camera.image_size[0] / height]).double()
    pixels = pixel_centers(height, width, dtype=torch.float64)[known] * ratio
    return unproject(frame.camera, pixels, depth[known].double()).numpy()


class CO3DSource(SequenceSource):
    """Sequences of one split of a category, or of several."""

    def __init__(
        self, members: SplitMembers, framing: ObjectFraming, files: Sequence[Path], refused: list[DataError]
    ) -> None:
        super().__init__(sorted(members.frames), members.listed, refused, members.left_out)
        self.framing = framing
        self._members = members
        self._files = files
        self._sequences: dict[str, PosedSequence] = {}

    def with_images(self, path_of: Callable[[Path], Path]) -> "CO3DSource":
        """Return the same sequences with images at other paths."""
        frames = {}
        for name, stored in self._members.frames.items():
            frames[name] = [frame._replace(image=path_of(frame.image)) for frame in stored]
        return CO3DSource(self._members._replace(frames=frames), self.framing, self._files, self.refused)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the annotations, not of the images."""
        digest = hashlib.sha256()
        for path in self._files:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def read(self, name: str) -> PosedSequence:
        """Return one sequence, whose cameras are computed at the first call."""
        if name not in self._sequences:
            with errors_at(sequence=name):
                self._sequences[name] = self._make(name)
        return self._sequences[name]

    def _make(self, name: str) -> PosedSequence:
        members = self._members
        size = self.framing.image_size
        frames = members.frames[name]
        placement = object_placement(members.point_clouds[name], frames, members.captured[name])
        numbers = [frame.number for frame in frames]
        cameras = [frame.camera for frame in frames]
        with errors_at(members.annotations[name]):
            read = partial(_read, name, frames, self.framing)
            sequence = placed_sequence(name, numbers, cameras, placement, self.framing, read)
        if not any(frame.depth for frame in frames):
            return sequence
        return replace(sequence, read_depth=partial(_read_depth, name, frames, size, sequence.scale))


def _read(name: str, frames: list[CO3DFrame], framing: ObjectFraming, index: int) -> MaskedImage:
    frame = frames[index]
    image_size = frames[index].camera.image_size
    with errors_at(sequence=name, frame=frame.number):
        image = decode_image(frame.image, str(frame.image), "RGB", image_size)
        mask = decode_image(frame.mask, str(frame.mask), "L", image_size)
        # CO3D's loader leaves out empty masks, too (`json_index_dataset.py`, `remove_empty_masks`).
        if image.getbbox() is None:
            raise BadImage("is black everywhere", str(frame.image))
        if mask.getbbox() is None:
            raise BadImage("shows no object", str(frame.mask))
        return framing.cut(frame.camera, image, mask)


def _read_depth(name: str, frames: list[CO3DFrame], size: int, factor: float, index: int) -> Float[Tensor, "1 _ _"]:
    with errors_at(sequence=name):
        return square_depth(frames[index], square_of(frames[index].camera), size, factor)
