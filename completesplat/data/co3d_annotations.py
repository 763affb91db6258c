"""CO3D v2's annotations: frames, cameras and the object's place, without PyTorch3D.

Layout: facebookresearch/co3d, `co3d/dataset/data_types.py`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData
from torch import Tensor

from completesplat.data.checks import field, finite_array, inside, read_json, require_file, require_rotation
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras

SPLITS = ("train", "val", "test")
# Largest distance along an axis from the point cloud's mean, after scaling (Splatter Image: 1.2 * 0.95 / 2).
OBJECT_HALF_SIZE = 0.57

VIEWPOINT_SHAPES = {"R": (3, 3), "T": (3,), "focal_length": (2,), "principal_point": (2,)}

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CO3DFrame:
    """One picture with its mask; `camera` is in float64, in the sequence's own units."""

    image: Path
    mask: Path
    camera: Cameras


@dataclass(frozen=True)
class CO3DSequence:
    """The frames of one video, in order, and the point cloud of its object."""

    name: str
    frames: tuple[CO3DFrame, ...]
    point_cloud: Path


def read_category(root: Path, category: str, subset: str) -> dict[str, list[CO3DSequence]]:
    """The sequences of a category by split ("train", "val", "test"), as the set list `subset` divides their frames.

    Sequences without a point cloud (which gives the scale) or with fewer than two frames are left out, with a warning.
    Frames that the set list does not name are not looked at.

    Raises:
        DataError: missing or malformed annotations, cameras that are none, or paths that lead outside of `root`.
    """
    folder = root / category
    if not folder.is_dir():
        raise DataError(f"no CO3D category at {folder}")
    frames_file, set_list = folder / "frame_annotations.jgz", folder / "set_lists" / f"set_lists_{subset}.json"
    splits = _read_set_list(set_list)
    clouds = _read_point_clouds(root, folder / "sequence_annotations.jgz")
    entries = _read_entries(frames_file)
    frames: dict[tuple[str, int], CO3DFrame] = {}
    for name, number in sorted(set().union(*splits.values())):
        if name not in clouds or (name, number) not in entries:
            raise DataError(f"{set_list} names {name}, frame {number}, of which the annotations know nothing")
        frames[name, number] = _read_frame(root, frames_file, entries[name, number])
    sequences: dict[str, list[CO3DSequence]] = {split: [] for split in SPLITS}
    for split, keys in splits.items():
        for name, keys_of_name in groupby(sorted(keys), key=itemgetter(0)):
            members, cloud = [frames[key] for key in keys_of_name], clouds[name]
            if cloud is None or len(members) < 2:
                logger.warning("left out %s of %s: no point cloud, or a single frame", name, folder)
            else:
                sequences[split].append(CO3DSequence(name, tuple(members), cloud))
    return sequences


def _read_set_list(path: Path) -> dict[str, set[tuple[str, int]]]:
    """(sequence name, frame number) of each split."""
    content, splits = read_json(path), {}
    for split in SPLITS:
        try:
            members = field(content, split, list)
            for member in members:
                if type(member) is not list or [type(part) for part in member[:2]] != [str, int]:
                    raise DataError(f"{split} has {member!r} where [sequence name, frame number, path] is expected")
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
        splits[split] = {(member[0], member[1]) for member in members}
    return splits


def _read_point_clouds(root: Path, path: Path) -> dict[str, Path | None]:
    """The point cloud of each sequence, where it has one."""
    clouds: dict[str, Path | None] = {}
    for number, entry in enumerate(_read_list(path)):
        try:
            name = field(entry, "sequence_name", str)
            if name in clouds:
                raise DataError(f"sequence {name} is there twice")
            cloud = entry.get("point_cloud")
            clouds[name] = None if cloud is None else inside(root, field(cloud, "path", str))
        except DataError as error:
            raise DataError(f"{path}: entry {number}: {error}") from None
    return clouds


def _read_entries(path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """The annotations of all frames by sequence name and frame number."""
    entries: dict[tuple[str, int], dict[str, Any]] = {}
    for number, entry in enumerate(_read_list(path)):
        try:
            key = field(entry, "sequence_name", str), field(entry, "frame_number", int)
        except DataError as error:
            raise DataError(f"{path}: entry {number}: {error}") from None
        if key in entries:
            raise DataError(f"{path}: {key[0]}, frame {key[1]} is there twice")
        entries[key] = entry
    return entries


def _read_list(path: Path) -> list[Any]:
    # CO3D is written by Python's `json`, which writes NaN; every number that is used is checked.
    content = read_json(path, allow_nan=True)
    if type(content) is not list:
        raise DataError(f"{path} must hold a list")
    return content


def _read_frame(root: Path, file: Path, entry: dict[str, Any]) -> CO3DFrame:
    try:
        image, mask = field(entry, "image", dict), field(entry, "mask", dict)
        size = field(image, "size", list)
        if [type(side) for side in size] != [int, int] or min(size) <= 0:
            raise DataError(f"the image's size must be two positive integers, not {size}")
        camera = camera_from_viewpoint(field(entry, "viewpoint", dict), size)
        return CO3DFrame(inside(root, field(image, "path", str)), inside(root, field(mask, "path", str)), camera)
    except DataError as error:
        raise DataError(f"{file}: {entry['sequence_name']}, frame {entry['frame_number']}: {error}") from None


def camera_from_viewpoint(viewpoint: dict[str, Any], image_size: Sequence[int]) -> Cameras:
    """OpenCV camera (float64, no batch axis) of a PyTorch3D viewpoint for an image of (height, width).

    PyTorch3D: X_cam = X_world R + T with row vectors, +x left, +y up, and coordinates on the image in units of half
    its width and height (`ndc_norm_image_bounds`) or of half its shorter side (`ndc_isotropic`), from its centre
    (`pytorch3d/implicitron/dataset/frame_data.py:756`, `renderer/camera_conversions.py:64`).

    Raises:
        DataError: missing keys, anything but finite numbers in the right shapes, no rotation (to 1e-3), a focal length
            that is not positive, a principal point outside of the image, or another intrinsics format.
    """
    height, width = image_size
    half = np.array([width, height]) / 2
    # Annotations older than the field carry the default of the format.
    layout = viewpoint.get("intrinsics_format", "ndc_norm_image_bounds")
    if layout not in ("ndc_norm_image_bounds", "ndc_isotropic"):
        raise DataError(f"unknown intrinsics format {layout!r}")
    unit = half if layout == "ndc_norm_image_bounds" else np.full(2, half.min())
    numbers = {key: finite_array(viewpoint.get(key), shape, key) for key, shape in VIEWPOINT_SHAPES.items()}
    require_rotation(numbers["R"], "R")
    focal, center = numbers["focal_length"] * unit, half - numbers["principal_point"] * unit
    if not (focal > 0).all():
        raise DataError(f"focal_length must be positive, not {viewpoint['focal_length']}")
    if not ((center > 0) & (center < 2 * half)).all():
        raise DataError(f"principal point ({center[0]:g}, {center[1]:g}) lies outside of the {width} x {height} image")
    flip = np.diag([-1.0, -1.0, 1.0])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = flip @ numbers["R"].T
    world_to_camera[:3, 3] = flip @ numbers["T"]
    intrinsics = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    return Cameras(torch.from_numpy(world_to_camera), torch.from_numpy(intrinsics), (height, width))


def object_placement(point_cloud: Path) -> tuple[Float[Tensor, "3"], float]:
    """Centre of the object and the factor that brings its scene to the common scale.

    The mean of the points, and 0.57 / max |coordinate - mean| (Splatter Image, `co3d_normalisation.py`). Upstream turns
    the scene upright first. Poses relative to a reference do not see that rotation, save for the axes along which the
    largest coordinate is taken, so it is left out.

    Raises:
        DataError: a file that is missing, no PLY, empty, without extent or not finite.
    """
    try:
        vertices = PlyData.read(str(require_file(point_cloud)))["vertex"]
        points = np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in "xyz"], axis=-1)
    except DataError:
        raise
    except Exception as error:  # The parser raises nearly anything on a damaged file.
        raise DataError(f"not a point cloud: {point_cloud} ({type(error).__name__}: {error})") from None
    center = points.mean(axis=0) if len(points) else np.full(3, np.nan)
    extent = float(np.abs(points - center).max(initial=0.0))
    if not (np.isfinite(extent) and extent > 0):
        raise DataError(f"point cloud is empty, without extent or not finite: {point_cloud}")
    return torch.from_numpy(center), OBJECT_HALF_SIZE / extent
