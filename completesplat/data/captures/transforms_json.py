"""Reader of captures that consist of a `transforms.json` and images, the format of NeRF, instant-ngp and nerfstudio."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from completesplat.data.captures.captured_frames import (
    Capture,
    CapturedFrame,
    Lens,
    Listings,
    fit_lens,
    in_order,
    present_image,
    warn_of_missing,
)
from completesplat.data.validation import (
    ROTATION_TOLERANCE,
    field,
    finite_array,
    path_below,
    read_json,
    read_points,
    require_file,
    require_rotation,
)
from completesplat.errors import BadAnnotation, BadCamera, CompleteSplatError, TooFewFrames, errors_at
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.photo.exif import ORIENTATION, read_exif
from completesplat.photo.files import stored_size
from completesplat.photo.reading import Framing, read_square
from completesplat.scene import Views
from completesplat.tensors import stack

logger = logging.getLogger(__name__)

# OpenCV's distortion coefficients, and those of each camera model. There is no `k4`, on which programs disagree.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
USED: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": COEFFICIENTS,
}
OTHER_LENSES = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
MOST_SKEW = 0.1  # of rotations that are made orthonormal, as entries of R R^T - I
FEWEST_CAMERAS = 2
SAME_FOCAL = 1e-3
POLYCAM = {
    "fl_x": "fx",
    "fl_y": "fy",
    "cx": "cx",
    "cy": "cy",
    "w": "width",
    "h": "height",
}


def read_transforms(path: Path) -> Capture:
    """Read `transforms.json`, where values of a frame override those of the file.

    `transform_matrix` is camera-to-world with OpenGL's axes (+x right, +y up, +z backward; nerfstudio, "Data
    conventions"). Intrinsics are `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, or NeRF's `camera_angle_x`. By default the size
    is the image's, the principal point its centre, and `fl_y` equals `fl_x`. `cx` and `cy` are relative to the outer
    corner of the first pixel, as in COLMAP, from which nerfstudio converts them (`process_data/colmap_utils.py`).
    `mask_path` is a mask of the foreground. `ply_file_path` has points in the poses' world (`create_ply_from_colmap`).
    Paths are relative to the file's folder and stay in it.

    Frames without an image are left out, as instant-ngp leaves out those with a `sharpness` (`nerf_loader.cu`). Its
    capture of a fox lists 67 frames and has 50 images.

    Raises:
        DataError: something is missing, malformed or impossible; the error names the file and the frame's number.
    """
    content = read_json(path, allow_nan=True)  # NaN is refused later, with the number of its frame.
    frames = _read_frames(path, content)
    with errors_at(path):
        ordered = in_order(frames)
        if content.get("ply_file_path") is None:
            return Capture((path,), ordered, None)
        cloud = path_below(path.parent, field(content, "ply_file_path", str))
        points = read_points(cloud)
    return Capture((path, cloud), ordered, points if len(points) else None)


def read_polycam(keyframes: Path) -> Capture:
    """Read the images and cameras, one file for each, of Polycam's raw data, corrected by Polycam or else by the phone.

    `t_00` to `t_23` are the rows of `transform_matrix` (nerfstudio, `process_data/polycam_utils.py`).

    Raises:
        DataError: as in `read_transforms`.
    """
    kind = "corrected_" if (keyframes / "corrected_cameras").is_dir() else ""
    files = sorted((keyframes / f"{kind}cameras").glob("*.json"))
    entries = []
    for file in files:
        camera = read_json(file, allow_nan=True)
        with errors_at(file):
            rows = [[field(camera, f"t_{row}{column}", float) for column in range(4)] for row in range(3)]
        values = {name: camera.get(key) for name, key in POLYCAM.items()}
        values["file_path"] = f"{kind}images/{file.stem}"
        values["transform_matrix"] = [*rows, [0, 0, 0, 1]]
        entries.append(values)
    frames = _read_frames(keyframes / f"{kind}cameras", {"frames": entries})
    return Capture(tuple(files), in_order(frames), None)


def read_photographs(images: Sequence[Path], path: Path, size: int) -> Views:
    """Read photos and their cameras in `transforms.json`. Undistort, crop and resize them as `read_square` does.

    Returns:
        Views [view ...] in the order of the photos, in the world of the first camera and the file's units.

    Raises:
        DataError: as in `read_transforms`, but few frames suffice; or a photo is turned by EXIF or has another size.
        CompleteSplatError: a photo is not in the file.
    """
    frames = {frame.image.resolve(): frame for frame in _read_frames(path, read_json(path, allow_nan=True))}
    squares = []
    cameras = []
    for image in images:
        frame = frames.get(image.resolve())
        if frame is None:
            raise CompleteSplatError(f"{image}: {path} has no frame with this image")
        undistorted, _ = frame.read()
        if ORIENTATION in read_exif(undistorted):  # `read_square` would turn it
            undistorted = Image.fromarray(np.array(undistorted))
        squares.append(read_square(undistorted, Framing(size), crop="center").image)
        camera = frame.camera()
        height, width = camera.image_size
        side = min(camera.image_size)
        cameras.append(crop_resize(camera, (width - side) // 2, (height - side) // 2, side, size))
    placed = stack(cameras)
    relative = placed.relative_to(placed[0]).to(torch.float32)
    return Views(torch.stack(squares), relative, torch.ones(len(squares), 1, size, size))


def read_cameras(path: Path, size: int) -> list[Cameras]:
    """Read the cameras of a `transforms.json`, whose images need not exist, for images with a shorter side of `size`.

    Without `w` and `h` the images are square.

    Raises:
        DataError: as in `read_transforms`; or the lens distorts, its focal lengths differ, or `fl_x` is without a size.
    """
    content = read_json(path)
    cameras = []
    with errors_at(path):
        for number, entry in enumerate(field(content, "frames", list)):
            with errors_at(frame=number):
                if type(entry) is not dict:
                    raise BadAnnotation("must be an object with transform_matrix")
                values = {**content, **entry}
                if not {"w", "h"} <= values.keys():
                    if "fl_x" in values:
                        raise BadAnnotation("fl_x is in pixels, but w and h are missing")
                    values["w"] = size
                    values["h"] = size
                lens = _read_lens(values, path)
                pose = torch.from_numpy(_read_pose(entry.get("transform_matrix"))[0])
                if any(lens.distortion) or not math.isclose(*lens.focal, rel_tol=SAME_FOCAL):
                    raise BadCamera(f"only pinhole cameras are rendered, not {lens.focal}, {lens.distortion}")
                height, width = lens.image_size
                scale = size / min(lens.image_size)
                f, _ = lens.focal
                x, y = lens.center
                intrinsics = scale * torch.tensor([[f, 0, x], [0, f, y], [0, 0, 1 / scale]], dtype=torch.float64)
                cameras.append(Cameras(pose, intrinsics, (round(scale * height), round(scale * width))))
        if len(cameras) < FEWEST_CAMERAS:
            raise TooFewFrames(f"{len(cameras)} frames; at least {FEWEST_CAMERAS} are rendered")
    return cameras


def _read_frames(path: Path, content: Any) -> list[CapturedFrame]:
    root = path.parent
    frames = []
    missing = []
    skew = 0.0
    listings: Listings = {}
    with errors_at(path):
        entries = field(content, "frames", list)
        for number, entry in enumerate(entries):
            with errors_at(frame=number):
                name = field(entry, "file_path", str)
                image = present_image(root, name, listings)
                if not isfile(image):
                    missing.append(name)
                    continue
                mask = None
                if entry.get("mask_path") is not None:
                    mask = require_file(path_below(root, field(entry, "mask_path", str)))
                values = {**content, **entry}
                pose, error = _read_pose(entry.get("transform_matrix"))
                skew = max(skew, error)
                frame = CapturedFrame(number, image, mask, _read_lens(values, image), pose)
                sized = {"w", "h"} <= values.keys()
                frames.append(fit_lens(frame) if sized else replace(frame, orientation="unknown"))
    warn_of_missing(path, missing, len(entries))
    if skew > ROTATION_TOLERANCE:
        logger.warning("%s: rotations are not orthonormal (R R^T - I up to %.2g) and are made so", path, skew)
    return frames


def _read_pose(matrix: object) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Convert `transform_matrix` to world-to-camera with OpenCV's axes, and return also its entry of R R^T - I."""
    pose = finite_array(matrix, (4, 4), "transform_matrix")
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise BadCamera(f"transform_matrix ends in the row {pose[3].tolist()}, not in 0, 0, 0, 1")
    skew = require_rotation(pose[:3, :3], "the rotation of transform_matrix", MOST_SKEW)
    # The nearest rotation: even an error of rounding would be multiplied by the distance from the origin.
    u, _, vt = np.linalg.svd(pose[:3, :3] * [1, -1, -1])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = (u @ vt).T
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ pose[:3, 3]
    return world_to_camera, skew


def _read_lens(values: Mapping[str, object], image: Path) -> Lens:
    model = values.get("camera_model", "OPENCV")
    unsupported = [key for key in OTHER_LENSES if values.get(key)]
    if not isinstance(model, str) or model not in USED or unsupported:
        name = unsupported[0] if unsupported else model
        raise BadCamera(f"camera model {name} is not supported; there are: {', '.join(USED)}")

    def number(key: str, default: float | None = None) -> float:
        if default is not None and key not in values:
            return default
        return float(finite_array(values.get(key), (), key))

    if {"w", "h"} <= values.keys():
        height = int(number("h"))  # instant-ngp writes floats.
        width = int(number("w"))
    else:
        height, width = stored_size(image, str(image))
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
    return Lens((fx, fy), center, (height, width), (k1, k2, p1, p2, k3))


def _focal(angle: float, side: int) -> float:
    if not 0 < angle < math.pi:
        raise BadCamera(f"a field of view of {angle:g} radians")
    return side / 2 / math.tan(angle / 2)
