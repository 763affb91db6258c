"""CO3D sequences as posed sequences: cropped, scaled to a common object size, with a depth range around the object."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.co3d.annotations import CO3DFrame
from completesplat.data.co3d.splits import SplitMembers
from completesplat.data.images.crop import Square, principal_square, read_square
from completesplat.data.images.files import decode, read_depth
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.data.validation import BadCamera, BadPlacement, at, read_points
from completesplat.errors import DataError
from completesplat.geometry.cameras import crop_resize, invert_rigid, pixel_centers, transform_points, unproject
from completesplat.tensors import stack

DEPTH_MAPS = 8
DEPTH_QUANTILE = 0.99
FOREGROUND = 128  # smallest mask value, of 255
# Optical axes count as parallel if the smallest eigenvalue (at most 1) is below this.
PARALLEL = 1e-4
UP = 1
# The object's half size (see `Placement`) after scaling (Splatter Image: 1.2 * 0.95 / 2).
OBJECT_HALF_SIZE = 0.57
SMALLEST_NEAR = 0.1
# Cameras that move by less than this share of their distance to the object show only one view of it.
SMALLEST_BASELINE = 0.01


Axes = Float[np.ndarray, "3 3"]


def square_depth(frame: CO3DFrame, square: Square, size: int, factor: float) -> Float[Tensor, "1 size size"]:
    """Return depth along the optical axis at the pixel centres of the square image; 0 where it is unknown.

    Sampling is nearest-neighbour, because a mean across an edge is the depth of no surface. The depth map may differ in
    size from its image. `factor` converts the sequence's units to the common scale.

    Raises:
        DataError: the depth map cannot be read.
    """
    if frame.depth is None:
        return torch.zeros(1, size, size)
    with at(frame=frame.number):
        depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
    places = []
    for count, side, start in zip(depth.shape, frame.camera.image_size, (square.top, square.left), strict=True):
        centers = start + (torch.arange(size, dtype=torch.float64) + 0.5) * square.side / size
        places.append((centers * count / side).long().clamp(0, count - 1))
    rows, columns = places
    return factor * depth[rows[:, None], columns][None]


class Placement(NamedTuple):
    """Centre and half size of the object; the latter is the largest distance from the centre along an upright axis."""

    center: Float[Tensor, "3"]
    half_size: float


def object_placement(point_cloud: Path | None, frames: Sequence[CO3DFrame], captured: Sequence[CO3DFrame]) -> Placement:
    """Locate the object by the point cloud, else by the frames' depth maps, else by their cameras.

    The axes come from `captured`, all frames of the sequence.

    Raises:
        DataError: the point cloud, a depth map or a mask is missing or unreadable.
        BadPlacement: the points are missing, not finite or all in one place; no foreground has a known depth; or the
            optical axes are parallel or meet behind the cameras.
    """
    if point_cloud is not None:
        return from_point_cloud(point_cloud, upright_axes(captured))
    with_depth = [frame for frame in frames if frame.depth is not None]
    return from_depth_maps(with_depth, upright_axes(captured)) if with_depth else from_cameras(frames)


def upright_axes(frames: Sequence[CO3DFrame]) -> Axes:
    """Return the axes of an upright frame in the sequence's world, as columns; the second points up or down.

    People hold a camera level, so its x axis varies least along the vertical. It varies most along the first of these
    axes (Splatter Image, `co3d_normalisation.py`).
    """
    sideways = torch.stack([frame.camera.world_to_camera[0, :3] for frame in frames]).numpy()
    sideways = sideways - sideways.mean(axis=0)
    least, middle, most = np.linalg.eigh(sideways.T @ sideways)[1].T
    return np.stack([most, least, middle], axis=-1)


def from_point_cloud(path: Path, axes: Axes) -> Placement:
    """Place the object as Splatter Image does (`co3d_normalisation.py`).

    The centre is the points' mean, but its height is the middle between the lowest and the highest point. The half size
    is the largest absolute coordinate relative to this centre, along the upright axes.
    """
    _, points = read_points(path)
    with at(path):
        return _placement(points, axes, 1.0, "the point cloud")


def from_depth_maps(frames: Sequence[CO3DFrame], axes: Axes) -> Placement:
    """Place the object by the foreground points of up to 8 evenly spaced depth maps, as with a point cloud.

    The 99 % and 1 % quantiles replace the largest and smallest values, because depth maps have outliers.
    """
    count, points = min(len(frames), DEPTH_MAPS), []
    for frame in (frames[i * len(frames) // count] for i in range(count)):
        with at(frame=frame.number):
            points.append(_foreground(frame))
    return _placement(np.concatenate(points), axes, DEPTH_QUANTILE, "the depth maps' foreground")


def from_cameras(frames: Sequence[CO3DFrame]) -> Placement:
    """Place the object at the point nearest to all optical axes; assume that it fills the images' largest square."""
    world_to_camera = torch.stack([frame.camera.world_to_camera for frame in frames])
    axes, eyes = world_to_camera[:, 2, :3], invert_rigid(world_to_camera)[:, :3, 3]
    # The squared distance of x to an axis is (x - eye)^T P (x - eye), where P takes out the part along the axis.
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(dim=0))[0] < PARALLEL:
        raise BadPlacement("no point cloud, no depth maps, and optical axes that do not meet")
    center = torch.linalg.solve(across.sum(dim=0), (across @ eyes[:, :, None]).sum(dim=0)).squeeze(-1)
    depths = transform_points(world_to_camera, center[None])[:, 0, 2]
    # Half the side of each frame's square, at depth 1.
    extents = [0.5 * _square(frame).side / frame.camera.intrinsics.diagonal()[:2].max().item() for frame in frames]
    half_size = (depths * torch.tensor(extents, dtype=depths.dtype)).median().item()
    if not (half_size > 0 and np.isfinite(half_size)):
        raise BadPlacement("no point cloud, no depth maps, and optical axes that meet behind the cameras")
    return Placement(center, half_size)


def _foreground(frame: CO3DFrame) -> np.ndarray:
    """Return the world points [n 3] of a depth map's foreground; the map may be smaller than the image."""
    if frame.depth is None:
        return np.zeros((0, 3))
    depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
    mask = decode(frame.mask, str(frame.mask), "L", frame.camera.image_size)
    height, width = depth.shape
    known = (depth > 0) & torch.from_numpy(np.asarray(mask.resize((width, height))) >= FOREGROUND)
    ratio = torch.tensor([frame.camera.image_size[1] / width, frame.camera.image_size[0] / height]).double()
    pixels = pixel_centers(height, width, dtype=torch.float64)[known] * ratio
    return unproject(frame.camera, pixels, depth[known].double()).numpy()


def _placement(points: np.ndarray, axes: Axes, quantile: float, what: str) -> Placement:
    if not len(points) or not np.isfinite(points).all():
        raise BadPlacement(f"{what} is empty or not finite")
    mean = points.mean(axis=0)
    upright = (points - mean) @ axes
    middle = np.quantile(upright[:, UP], [1 - quantile, quantile]).mean()
    upright[:, UP] -= middle
    half_size = float(np.quantile(np.abs(upright), quantile, axis=0).max())
    if not half_size > 0:
        raise BadPlacement(f"{what} is without extent")
    return Placement(torch.from_numpy(mean + middle * axes[:, UP]), half_size)


@dataclass(frozen=True)
class ObjectFraming:
    """Settings of images and cameras; see `CO3DDataModule`."""

    image_size: int
    depth_before: float
    depth_after: float


class CO3DSource(SequenceSource):
    """Sequences of one split; see `SequenceSource`."""

    def __init__(
        self, members: SplitMembers, framing: ObjectFraming, files: Sequence[Path], refused: list[DataError]
    ) -> None:
        self.names = sorted(members.frames)
        self.left_out = members.left_out
        self.listed = members.listed
        self.refused = refused
        self.framing = framing
        self._members = members
        self._files = files
        self._sequences: dict[str, PosedSequence] = {}

    def fingerprint(self) -> str:
        """Return the SHA-256 of the annotations, not of the images."""
        return hashlib.sha256(b"".join(hashlib.sha256(f.read_bytes()).digest() for f in self._files)).hexdigest()

    def read(self, name: str) -> PosedSequence:
        """Return one sequence; its cameras are computed at the first call."""
        if name not in self._sequences:
            with at(sequence=name):
                self._sequences[name] = self._make(name)
        return self._sequences[name]

    def _make(self, name: str) -> PosedSequence:
        members, size = self._members, self.framing.image_size
        frames = members.frames[name]
        placement = object_placement(members.point_clouds[name], frames, members.captured[name])
        factor = OBJECT_HALF_SIZE / placement.half_size
        cameras = stack([crop_resize(frame.camera, *_square(frame), size) for frame in frames])
        cameras = cameras.scale_world(torch.tensor(factor, dtype=torch.float64))
        depths = transform_points(cameras.world_to_camera, factor * placement.center[None])[..., 0, 2]
        baseline = (cameras.centers - cameras.centers[0]).norm(dim=-1).max()
        if not baseline > SMALLEST_BASELINE * depths.abs().mean():
            raise BadCamera("the cameras do not move", str(self._files[0]))
        near = (depths - self.framing.depth_before).clamp(min=SMALLEST_NEAR)
        # If a broken pose puts the object behind the camera, the depth range still has a positive length.
        return PosedSequence(
            name,
            tuple(frame.number for frame in frames),
            cameras,
            torch.stack([near, torch.maximum(depths, near) + self.framing.depth_after], dim=-1).to(torch.float32),
            partial(_read, name, frames, size),
            partial(_read_depth, name, frames, size, factor) if any(frame.depth for frame in frames) else None,
        )


def _square(frame: CO3DFrame) -> Square:
    x, y = frame.camera.intrinsics[:2, 2].tolist()
    return principal_square((x, y), frame.camera.image_size)


def _read(name: str, frames: list[CO3DFrame], size: int, index: int) -> MaskedImage:
    frame = frames[index]
    square, image_size = _square(frame), frame.camera.image_size
    with at(sequence=name, frame=frame.number):
        image = read_square(frame.image, image_size, square, size, "RGB")
        return MaskedImage(image, read_square(frame.mask, image_size, square, size, "L"))


def _read_depth(name: str, frames: list[CO3DFrame], size: int, factor: float, index: int) -> Float[Tensor, "1 _ _"]:
    with at(sequence=name):
        return square_depth(frames[index], _square(frames[index]), size, factor)
