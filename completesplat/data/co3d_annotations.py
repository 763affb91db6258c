"""CO3D v2's annotations: frames, cameras and the object's place, without PyTorch3D.

Layout: facebookresearch/co3d, `co3d/dataset/data_types.py`..
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyParseError
from torch import Tensor

from completesplat.data.checks import inside, read_json, require_file
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras

SPLITS = ("train", "val", "test")
# Largest distance along an axis from the point cloud's mean, after scaling (Splatter Image: 1.2 * 0.95 / 2).
OBJECT_HALF_SIZE = 0.57

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

    Raises:
        DataError: missing or malformed annotations, or paths that lead outside of `root`.
    """
    folder = root / category
    if not folder.is_dir():
        raise DataError(f"no CO3D category at {folder}")
    set_list = read_json(folder / "set_lists" / f"set_lists_{subset}.json")
    try:
        wanted = {(split, seq, number) for split in SPLITS for seq, number, *_ in set_list[split]}
        clouds = {s["sequence_name"]: s["point_cloud"] for s in read_json(folder / "sequence_annotations.jgz")}
        annotations = sorted(read_json(folder / "frame_annotations.jgz"), key=lambda entry: entry["frame_number"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"annotations of {folder} are not in CO3D v2's format: {error!r}") from None
    frames: dict[tuple[str, str], list[CO3DFrame]] = {}
    for entry in annotations:
        name, number = entry["sequence_name"], entry["frame_number"]
        for split in SPLITS:
            if (split, name, number) in wanted:
                frames.setdefault((split, name), []).append(_read_frame(root, entry))
    sequences: dict[str, list[CO3DSequence]] = {split: [] for split in SPLITS}
    for (split, name), members in sorted(frames.items()):
        cloud = clouds.get(name)
        if cloud is None or len(members) < 2:
            logger.warning("left out %s of %s: no point cloud, or a single frame", name, folder)
        else:
            sequences[split].append(CO3DSequence(name, tuple(members), inside(root, cloud["path"])))
    return sequences


def _read_frame(root: Path, entry: dict[str, Any]) -> CO3DFrame:
    try:
        image, mask = inside(root, entry["image"]["path"]), inside(root, entry["mask"]["path"])
        return CO3DFrame(image, mask, camera_from_viewpoint(entry["viewpoint"], entry["image"]["size"]))
    except (KeyError, TypeError, ValueError) as error:
        frame = f"{entry['sequence_name']}, frame {entry['frame_number']}"
        raise DataError(f"annotation of {frame} below {root} is not in CO3D v2's format: {error!r}") from None


def camera_from_viewpoint(viewpoint: dict[str, Any], image_size: Sequence[int]) -> Cameras:
    """OpenCV camera (float64, no batch axis) of a PyTorch3D viewpoint for an image of (height, width).

    PyTorch3D: X_cam = X_world R + T with row vectors, +x left, +y up, and coordinates on the image in units of half
    its width and height (`ndc_norm_image_bounds`) or of half its shorter side (`ndc_isotropic`), from its centre
    (`pytorch3d/implicitron/dataset/frame_data.py:756`, `renderer/camera_conversions.py:64`).

    Raises:
        DataError: another intrinsics format.
    """
    height, width = (int(side) for side in image_size)
    half = np.array([width, height]) / 2
    # Annotations older than the field carry the default of the format.
    layout = viewpoint.get("intrinsics_format", "ndc_norm_image_bounds")
    if layout not in ("ndc_norm_image_bounds", "ndc_isotropic"):
        raise DataError(f"unknown intrinsics format {layout!r}")
    unit = half if layout == "ndc_norm_image_bounds" else np.full(2, half.min())
    focal = np.array(viewpoint["focal_length"], dtype=np.float64) * unit
    center = half - np.array(viewpoint["principal_point"], dtype=np.float64) * unit
    flip = np.diag([-1.0, -1.0, 1.0])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = flip @ np.array(viewpoint["R"], dtype=np.float64).T
    world_to_camera[:3, 3] = flip @ np.array(viewpoint["T"], dtype=np.float64)
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
    except (PlyParseError, KeyError, ValueError) as error:
        raise DataError(f"not a point cloud: {point_cloud} ({error})") from None
    center = points.mean(axis=0) if len(points) else np.full(3, np.nan)
    extent = float(np.abs(points - center).max(initial=0.0))
    if not (np.isfinite(extent) and extent > 0):
        raise DataError(f"point cloud is empty, without extent or not finite: {point_cloud}")
    return torch.from_numpy(center), OBJECT_HALF_SIZE / extent
