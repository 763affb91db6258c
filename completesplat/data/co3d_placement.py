"""Where the object of a CO3D sequence is and how large, in the sequence's own units."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData
from torch import Tensor

from completesplat.data.checks import BadPlacement, UnreadableFile, at, require_file
from completesplat.data.co3d_annotations import CO3DFrame
from completesplat.data.images import decode, read_depth
from completesplat.data.transforms import principal_square
from completesplat.geometry.cameras import invert_rigid, pixel_centers, transform_points, unproject

DEPTH_MAPS = 8
DEPTH_QUANTILE = 0.99
FOREGROUND = 128  # of 255
# Smaller eigenvalues than this (of at most 1) mean that the optical axes are parallel.
PARALLEL = 1e-4
UP = 1

Axes = Float[np.ndarray, "3 3"]


class Placement(NamedTuple):
    """Centre of the object and half its size: the largest distance from the centre along one of the upright axes."""

    center: Float[Tensor, "3"]
    half_size: float


def object_placement(point_cloud: Path | None, frames: Sequence[CO3DFrame], captured: Sequence[CO3DFrame]) -> Placement:
    """From the point cloud; without one from the depth maps; without those from the cameras alone.

    Args:
        frames: whose depth maps and cameras count.
        captured: all frames of the sequence, which tell the axes.

    Raises:
        DataError: what would tell is unreadable, empty, without extent or not finite.
    """
    if point_cloud is not None:
        return from_point_cloud(point_cloud, upright_axes(captured))
    with_depth = [frame for frame in frames if frame.depth is not None]
    return from_depth_maps(with_depth, upright_axes(captured)) if with_depth else from_cameras(frames)


def upright_axes(frames: Sequence[CO3DFrame]) -> Axes:
    """The axes of an upright frame in the sequence's world, as columns; the second points up, or down.

    People hold a camera level: its x axis varies least upwards and most along the first of these axes (Splatter Image,
    `co3d_normalisation.py`).
    """
    sideways = torch.stack([frame.camera.world_to_camera[0, :3] for frame in frames]).numpy()
    sideways = sideways - sideways.mean(axis=0)
    least, middle, most = np.linalg.eigh(sideways.T @ sideways)[1].T
    return np.stack([most, least, middle], axis=-1)


def from_point_cloud(path: Path, axes: Axes) -> Placement:
    """As Splatter Image places it (`co3d_normalisation.py`).

    The centre is the points' mean, but upwards the middle between the lowest and the highest; half the size is the
    largest coordinate from there, along the upright axes.

    Raises:
        MissingFile: no such file.
        UnreadableFile: no PLY.
        BadPlacement: no points, points in one place, or points that are not finite.
    """
    require_file(path)
    try:
        vertices = PlyData.read(str(path))["vertex"]
        points = np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in "xyz"], axis=-1)
    except Exception as error:  # The parser raises nearly anything on a damaged file.
        raise UnreadableFile(f"not a point cloud ({type(error).__name__}: {error})", str(path)) from None
    with at(path):
        return _placement(points, axes, 1.0, "the point cloud")


def from_depth_maps(frames: Sequence[CO3DFrame], axes: Axes) -> Placement:
    """From what up to 8 evenly spaced depth maps show of the foreground, as if that were the point cloud.

    Depth maps have outliers: the 99 % quantile counts instead of the largest value, and the 1 % quantile instead of
    the smallest.

    Raises:
        DataError: a depth map or a mask is missing or unreadable.
        BadPlacement: no foreground with a known depth.
    """
    chosen = [frames[i * len(frames) // DEPTH_MAPS] for i in range(DEPTH_MAPS)] if len(frames) > DEPTH_MAPS else frames
    points = []
    for frame in chosen:
        with at(frame=frame.number):
            points.append(_foreground(frame))
    return _placement(np.concatenate(points), axes, DEPTH_QUANTILE, "the depth maps' foreground")


def from_cameras(frames: Sequence[CO3DFrame]) -> Placement:
    """The point that is nearest to all optical axes; the object is taken to fill the largest square of the pictures.

    Raises:
        BadPlacement: optical axes that are parallel, or meet behind the cameras.
    """
    world_to_camera = torch.stack([frame.camera.world_to_camera for frame in frames])
    axes, eyes = world_to_camera[:, 2, :3], invert_rigid(world_to_camera)[:, :3, 3]
    # The squared distance of x to an axis is (x - eye)^T P (x - eye), where P takes out the part along the axis.
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(dim=0))[0] < PARALLEL:
        raise BadPlacement("no point cloud, no depth maps, and optical axes that do not meet")
    center = torch.linalg.solve(across.sum(dim=0), (across @ eyes[:, :, None]).sum(dim=0)).squeeze(-1)
    depths = transform_points(world_to_camera, center[None])[:, 0, 2]
    half_size = (depths * torch.tensor([_half_extent(frame) for frame in frames], dtype=depths.dtype)).median().item()
    if not (half_size > 0 and np.isfinite(half_size)):
        raise BadPlacement("no point cloud, no depth maps, and optical axes that meet behind the cameras")
    return Placement(center, half_size)


def _half_extent(frame: CO3DFrame) -> float:
    """Half the side of the largest square around the principal point, at depth 1."""
    (x, y), focal = frame.camera.intrinsics[:2, 2].tolist(), frame.camera.intrinsics.diagonal()[:2].max().item()
    side = principal_square((x, y), frame.camera.image_size).side
    return 0.5 * side / focal


def _foreground(frame: CO3DFrame) -> np.ndarray:
    """World points [n 3] of a depth map's foreground; the map may be smaller than the picture."""
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
