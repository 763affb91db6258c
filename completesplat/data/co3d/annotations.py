"""Annotations of CO3D v2, read without PyTorch3D (facebookresearch/co3d, `co3d/dataset/data_types.py`)."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from completesplat.data.validation import field, finite_array, path_below, read_json, require_rotation
from completesplat.errors import BadAnnotation, BadCamera, Refuse, errors_at, refused_to
from completesplat.geometry.cameras import Cameras
from completesplat.photo.files import MOST_PIXELS

# From OpenCV's camera axes (+x right, +y down) to PyTorch3D's (+x left, +y up), and back.
FLIP = np.diag([-1.0, -1.0, 1.0])
JsonObject = Mapping[str, object]
VIEWPOINT_SHAPES = {"R": (3, 3), "T": (3,), "focal_length": (2,), "principal_point": (2,)}


class DepthMap(NamedTuple):
    """File of a depth map, and the factor that converts its values to the sequence's units."""

    path: Path
    scale_adjustment: float


class CO3DFrame(NamedTuple):
    """One image with its mask. `camera` is in float64 and in the sequence's own units."""

    number: int
    image: Path
    mask: Path
    depth: DepthMap | None
    camera: Cameras


Frames = dict[str, dict[int, CO3DFrame]]
"""Frames by sequence and number."""


class CO3DVideo(NamedTuple):
    """Annotation of a whole sequence, where a quality is None if it is missing or NaN."""

    point_cloud: Path | None
    point_cloud_quality: float | None
    viewpoint_quality: float | None


def read_videos(root: Path, path: Path, refuse: Refuse) -> dict[str, CO3DVideo]:
    """Read the sequences in `sequence_annotations.jgz` by name, and pass the errors of single entries to `refuse`.

    Raises:
        DataError: the file is missing, unreadable or not a list.
    """
    videos: dict[str, CO3DVideo] = {}
    for name, entry in _entries(path, refuse):
        with refused_to(refuse, path, name):
            if name in videos:
                raise BadAnnotation("the sequence is annotated twice")
            quality = _optional_number(entry, "viewpoint_quality_score")
            if entry.get("point_cloud") is None:
                videos[name] = CO3DVideo(None, None, quality)
                continue
            cloud = field(entry, "point_cloud", dict)
            path_of_cloud = path_below(root, field(cloud, "path", str))
            videos[name] = CO3DVideo(path_of_cloud, _optional_number(cloud, "quality_score"), quality)
    return videos


def _optional_number(entry: JsonObject, key: str) -> float | None:
    value = entry.get(key)
    # CO3D's annotations have NaN for scores that could not be computed.
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return float(finite_array(value, (), key))


def read_frames(root: Path, path: Path, wanted: Callable[[str, int], bool], refuse: Refuse) -> Frames:
    """Read those frames in `frame_annotations.jgz` that are `wanted`, by sequence and number, as `read_videos` does."""
    frames: Frames = {}
    for name, entry in _entries(path, refuse):
        with refused_to(refuse, path, name):
            number = field(entry, "frame_number", int)
            if wanted(name, number):
                with errors_at(frame=number):
                    if number in frames.get(name, ()):
                        raise BadAnnotation("the frame is annotated twice")
                    frames.setdefault(name, {})[number] = _frame(root, number, entry)
    return frames


def _entries(path: Path, refuse: Refuse) -> Iterator[tuple[str, JsonObject]]:
    """Yield the names of sequences and the entries of a file. Errors of entries without a name go to `refuse`."""
    # CO3D was written by Python's `json`, which writes NaN; every number is checked before use.
    content = read_json(path, allow_nan=True)
    if type(content) is not list:
        raise BadAnnotation("must hold a list", str(path))
    for index, entry in enumerate(content):
        try:
            name = field(entry, "sequence_name", str)
        except BadAnnotation as error:
            refuse(BadAnnotation(f"entry {index}: {error.reason}", str(path)))
            continue
        yield name, entry


def _frame(root: Path, number: int, entry: JsonObject) -> CO3DFrame:
    """Return the frame of an annotation."""
    image = field(entry, "image", dict)
    mask = field(entry, "mask", dict)
    depth = None
    size = field(image, "size", list)
    if [type(side) for side in size] != [int, int] or not 0 < min(size) <= max(size) <= MOST_PIXELS:
        expected = f"two positive integers of at most {MOST_PIXELS:,}"
        raise BadAnnotation(f"the image's size must be {expected}, not {str(size)[:80]}")
    camera = camera_from_viewpoint(field(entry, "viewpoint", dict), size)
    image_path = path_below(root, field(image, "path", str))
    mask_path = path_below(root, field(mask, "path", str))
    if entry.get("depth") is not None:
        stored = field(entry, "depth", dict)
        # Some writers write whole numbers as integers.
        scale = float(finite_array(stored.get("scale_adjustment"), (), "scale_adjustment"))
        depth = DepthMap(path_below(root, field(stored, "path", str)), scale)
    return CO3DFrame(number, image_path, mask_path, depth, camera)


def camera_from_viewpoint(viewpoint: JsonObject, image_size: Sequence[int]) -> Cameras:
    """Convert a PyTorch3D viewpoint to an OpenCV camera (float64, no batch axis) for an image of (height, width).

    In PyTorch3D, X_cam = X_world R + T with row vectors, +x is left and +y is up. Image coordinates start at the image
    centre; their unit is half the width and height (`ndc_norm_image_bounds`) or half the shorter side (`ndc_isotropic`)
    (`pytorch3d/implicitron/dataset/frame_data.py:756`, `renderer/camera_conversions.py:64`).

    Raises:
        BadAnnotation: a key is missing, a value is not finite or has another shape, or the format is unknown.
        BadCamera: R is no rotation (to 1e-3), a focal length is not positive, or the principal point is outside.
    """
    height, width = image_size
    half = np.array([width, height]) / 2
    # Older annotations lack this field; then the format's default applies.
    layout = viewpoint.get("intrinsics_format", "ndc_norm_image_bounds")
    if layout not in ("ndc_norm_image_bounds", "ndc_isotropic"):
        raise BadAnnotation(f"unknown intrinsics format {layout!r}")
    unit = half if layout == "ndc_norm_image_bounds" else np.full(2, half.min())
    numbers = {key: finite_array(viewpoint.get(key), shape, key) for key, shape in VIEWPOINT_SHAPES.items()}
    require_rotation(numbers["R"], "R")
    focal = numbers["focal_length"] * unit
    center = half - numbers["principal_point"] * unit
    if not ((focal > 0) & np.isfinite(focal)).all():
        raise BadCamera(f"focal_length must be positive and finite, not {viewpoint['focal_length']}")
    if not ((center > 0) & (center < 2 * half)).all():
        raise BadCamera(f"principal point ({center[0]:g}, {center[1]:g}) lies outside of the {width} x {height} image")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = FLIP @ numbers["R"].T
    world_to_camera[:3, 3] = FLIP @ numbers["T"]
    intrinsics = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    return Cameras(torch.from_numpy(world_to_camera), torch.from_numpy(intrinsics), (height, width))


def viewpoint(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"], focal: list[float], center: list[float]
) -> dict[str, object]:
    """Invert `camera_from_viewpoint`, with `focal` and `center` in units of half the image's sides."""
    return {
        "R": (FLIP @ rotation).T.tolist(),
        "T": (FLIP @ translation).tolist(),
        "focal_length": focal,
        "principal_point": center,
        "intrinsics_format": "ndc_norm_image_bounds",
    }
