"""Reader of captures as a `transforms.json` with images, the format of NeRF, instant-ngp and nerfstudio."""

import logging
import math
from collections.abc import Sequence
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from completesplat.data.captures.capture import (
    Capture,
    CapturedFrame,
    Lens,
    PointCloud,
    check_lens,
    in_order,
    make_cloud,
    read_picture,
)
from completesplat.data.images.files import stored_size
from completesplat.data.images.photograph import read_photograph
from completesplat.data.sequences import shortened
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    MissingFile,
    at,
    field,
    finite_array,
    inside,
    read_json,
    read_points,
    require_file,
    require_rotation,
)
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.scene import Views
from completesplat.tensors import stack

logger = logging.getLogger(__name__)

# OpenCV's distortion coefficients, and those that each camera model has; programs disagree on the meaning of `k4`.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
RADIAL = {"SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2")}
USED = {"SIMPLE_PINHOLE": (), "PINHOLE": (), **RADIAL, "OPENCV": COEFFICIENTS}
OTHER_LENSES = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # NeRF (synthetic) leaves the suffix out.
SCALE_TOLERANCE = 1e-3


def read_transforms(path: Path, most_missing: float = 0.5) -> Capture:
    """Read `transforms.json`; values of a frame override those of the file.

    `transform_matrix` is camera-to-world with OpenGL's axes (+x right, +y up, +z backward; nerfstudio, "Data
    conventions"). Intrinsics are `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, or NeRF's `camera_angle_x`. By default the size
    is the image's, the principal point its centre, and `fl_y` equals `fl_x`. `cx` and `cy` are relative to the outer
    corner of the first pixel, as in COLMAP, from which they are converted (nerfstudio, `process_data/colmap_utils.py`).
    `mask_path` is the foreground. `ply_file_path` is in the world of the poses (`create_ply_from_colmap`, ibid.).
    Paths are relative to the file's folder and stay in it.

    Frames without an image are left out (up to the share `most_missing`), as in instant-ngp for frames with a
    `sharpness` (`nerf_loader.cu`); its capture of a fox lists 67 frames and has 50 images.

    Raises:
        DataError: something is missing, malformed or impossible; the error has the file and the frame's number.
    """
    frames, content = _read_frames(path, most_missing)
    with at(path):
        ordered = in_order(frames)
        cloud = None if content.get("ply_file_path") is None else field(content, "ply_file_path", str)
        points = None if cloud is None else _read_cloud(inside(path.parent, cloud))
    return Capture(path.resolve().parent.name, path, ordered, points)


def read_photographs(pictures: Sequence[Path], path: Path, size: int) -> Views:
    """Read photos as `read_photograph` crops and resizes them, with their cameras in `transforms.json`.

    Returns:
        Views [view ...] in the order of the photos, in the world of the first camera and the file's units.

    Raises:
        DataError: as in `read_transforms`, except for too few frames; or EXIF turns a photo, or its size differs.
        CompleteSplatError: a photo is not in the file, or its lens has distortion.
    """
    frames = {frame.image.resolve(): frame for frame in _read_frames(path, most_missing=1)[0]}
    images, cameras = [], []
    for picture in pictures:
        frame = frames.get(picture.resolve())
        if frame is None:
            raise CompleteSplatError(f"{picture}: {path} has no frame with this picture")
        if any(frame.lens.distortion):
            hint = "import the capture (completesplat data import), which undistorts it, and use the pictures it writes"
            raise CompleteSplatError(f"{picture}: its lens distorts; {hint}")
        read_picture(frame.image, frame.lens.image_size)  # refuses images that `read_photograph` would turn
        images.append(read_photograph(frame.image, size).image)
        cameras.append(_of_square(frame, size))
    placed = stack(cameras)
    return Views(torch.stack(images), placed.relative_to(placed[0]), torch.ones(len(images), 1, size, size))


def _of_square(frame: CapturedFrame, size: int) -> Cameras:
    """Return the camera of the resized central square."""
    (height, width), (fx, fy), (x, y) = frame.lens.image_size, frame.lens.focal, frame.lens.center
    whole = Cameras(
        torch.tensor(frame.world_to_camera, dtype=torch.float32),
        torch.tensor([[fx, 0, x], [0, fy, y], [0, 0, 1]], dtype=torch.float32),
        (height, width),
    )
    side = min(height, width)
    return crop_resize(whole, (width - side) // 2, (height - side) // 2, side, size)


def _read_frames(path: Path, most_missing: float) -> tuple[list[CapturedFrame], dict[str, Any]]:
    """Return all frames that have images, and the file's content."""
    content = read_json(path, allow_nan=True)  # NaN is refused later, with the number of its frame.
    with at(path):
        entries = field(content, "frames", list)
        frames = []
        for number, image in _find_pictures(path, entries, most_missing).items():
            with at(frame=number):
                frames.append(_read_frame(path.parent, number, content, entries[number], image))
    return frames, content


def _find_pictures(path: Path, entries: Sequence[Any], most_missing: float) -> dict[int, Path]:
    """Return the images that exist, by the number of their frame."""
    paths, missing = {}, []
    for number, entry in enumerate(entries):
        with at(frame=number):
            name = field(entry, "file_path", str)
            candidates = [inside(path.parent, name + suffix) for suffix in SUFFIXES]
        # `Path.is_file` raises if a name is too long.
        if existing := [candidate for candidate in candidates if isfile(candidate)]:
            paths[number] = existing[0]
        else:
            missing.append(name)
    if missing:
        counted = f"{len(missing)} of {len(entries)} frames have no picture"
        named = shortened(missing)
        if len(missing) > most_missing * len(entries):
            raise MissingFile(f"{counted}, more than most_missing={most_missing:g}: {named}")
        logger.warning("%s: %s and are left out: %s", path, counted, named)
    return paths


def _read_frame(root: Path, number: int, content: dict[str, Any], entry: Any, image: Path) -> CapturedFrame:
    mask = None if entry.get("mask_path") is None else require_file(inside(root, field(entry, "mask_path", str)))
    lens = _read_lens({**content, **entry}, image)
    return CapturedFrame(number, image, mask, lens, _read_pose(entry.get("transform_matrix")))


def _read_pose(matrix: object) -> Float[np.ndarray, "4 4"]:
    """Convert `transform_matrix` to world-to-camera with OpenCV's axes."""
    pose = finite_array(matrix, (4, 4), "transform_matrix")
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise BadCamera(f"transform_matrix ends in the row {pose[3].tolist()}, not in 0, 0, 0, 1")
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if np.ptp(lengths) < SCALE_TOLERANCE < abs(lengths[0] - 1):
        raise BadCamera(f"transform_matrix scales by {lengths[0]:g}; a pose is a rotation and a translation")
    require_rotation(pose[:3, :3], "the rotation of transform_matrix")
    pose[:3, 1:3] *= -1
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return world_to_camera


def _read_lens(values: dict[str, Any], image: Path) -> Lens:
    model = values.get("camera_model", "OPENCV")
    others = [key for key in OTHER_LENSES if values.get(key)]
    if not isinstance(model, str) or model not in USED or others:
        raise BadCamera(f"camera model {others[0] if others else model} is not supported; there are: {', '.join(USED)}")
    number = partial(_number, values)
    stored = None if {"w", "h"} <= values.keys() else stored_size(image, str(image))
    height, width = stored or (_whole(values, "h"), _whole(values, "w"))
    if "fl_x" in values:
        fx = number("fl_x")
    elif "camera_angle_x" in values:
        fx = _focal(number("camera_angle_x"), width)
    else:
        raise BadAnnotation("neither fl_x nor camera_angle_x, for the frame or for all")
    fy = number("fl_y", fx)
    if "fl_x" not in values and "fl_y" not in values and "camera_angle_y" in values:
        fy = _focal(number("camera_angle_y"), height)
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        if key not in USED[model] and number(key, 0.0) != 0:
            raise BadCamera(f"{key} = {values[key]} has no meaning for camera model {model}")
    k1, k2, p1, p2, k3 = (number(key, 0.0) for key in COEFFICIENTS)
    center = number("cx", width / 2), number("cy", height / 2)
    return check_lens(Lens((fx, fy), center, (height, width), (k1, k2, p1, p2, k3)))


def _number(values: dict[str, Any], key: str, default: float | None = None) -> float:
    return default if default is not None and key not in values else float(finite_array(values.get(key), (), key))


def _whole(values: dict[str, Any], key: str) -> int:
    value = _number(values, key)  # instant-ngp writes 1920.0.
    if value != int(value):
        raise BadAnnotation(f"{key} must be a whole number, not {value}")
    return int(value)


def _focal(angle: float, side: int) -> float:
    if not 0 < angle < math.pi:
        raise BadCamera(f"a field of view of {angle:g} radians")
    return side / 2 / math.tan(angle / 2)


def _read_cloud(path: Path) -> PointCloud | None:
    vertices, points = read_points(path)
    names = [name for name in ("red", "green", "blue") if name in (vertices.dtype.names or ())]
    colors = [vertices[name] for name in names]
    usable = len(colors) == 3 and all(color.dtype == np.uint8 for color in colors)
    return make_cloud(points, np.stack(colors, axis=-1) if usable else np.full(points.shape, 128), path)
