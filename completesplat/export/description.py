"""Description of scenes in a folder, `scene.json`: the camera of the photo, settings and file names."""

import json
import os
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from completesplat.data.validation import field, finite_array, read_json, require_rotation
from completesplat.errors import BadAnnotation, BadCamera, DataError
from completesplat.export.cleaning import LARGEST
from completesplat.files import write_text
from completesplat.geometry.cameras import Cameras
from completesplat.photo.files import MOST_PIXELS
from completesplat.version import __version__
from completesplat.weights import sha256_of

SCENE_FILE = "scene.json"
UP = (0.0, -1.0, 0.0)  # direction up where a description has none
EXTREME = 1e6  # largest ratio of focal length and image, and of the direction up to unit length
CONVENTIONS = {
    "axes": "OpenCV's for cameras: +x right, +y down, +z forward; world_to_camera gives the world's",
    "world_to_camera": "4 x 4, rows first; maps homogeneous world points (as columns) to camera points",
    "intrinsics": "3 x 3, rows first, in pixels; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)",
    "image_size": "(height, width) in pixels",
    "units": "the data set's or model's own scale; not metres",
    "offset": "if settings have one: add it to all positions, in float64, for the capture's own coordinates",
    "quaternions": "(w, x, y, z), unit length",
    "colors": "sRGB, 0 to 1; the same from every direction, except where a .ply has f_rest_* (3D Gaussian Splatting's)",
}


def write_scene_json(
    path: str | Path, reference: Cameras, settings: Mapping[str, Any], seed: int, files: Mapping[str, str]
) -> None:
    """Write a scene's description, `settings` and `files` as JSON, or raise ValueError if a number is not finite."""
    scene = {
        "format": "completesplat scene 1",
        "reference_camera": plain_camera(reference),
        "conventions": CONVENTIONS,
        "settings": dict(settings),
        "seed": seed,
        "files": dict(files),
    }
    write_text(path, json.dumps(scene, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def plain_camera(camera: Cameras) -> dict[str, Any]:
    """Return one camera as values for JSON."""
    return {
        "world_to_camera": camera.world_to_camera.tolist(),
        "intrinsics": camera.intrinsics.tolist(),
        "image_size": list(camera.image_size),
    }


def is_described(folder: Path) -> bool:
    """Return whether a folder has a description of ours, perhaps a damaged one, and not another program's."""
    file = folder / SCENE_FILE
    try:
        content = read_json(file) if file.is_file() else None
    except DataError:
        return True
    return isinstance(content, dict) and "reference_camera" in content


def described_camera(entry: object) -> Cameras:
    """Return the camera in a description.

    Raises:
        DataError: there is none, or no camera has its numbers.
    """
    plain = field(entry, "reference_camera", dict)
    pose = finite_array(plain.get("world_to_camera"), (4, 4), "world_to_camera")
    intrinsics = finite_array(plain.get("intrinsics"), (3, 3), "intrinsics")
    height, width = finite_array(plain.get("image_size"), (2,), "image_size").tolist()
    longer = max(height, width)
    require_rotation(pose[:3, :3], "world_to_camera")
    if np.abs(pose).max() > LARGEST:
        raise BadCamera(f"world_to_camera is farther than {LARGEST:g} from the origin")
    if not 1 <= min(height, width) <= height * width <= MOST_PIXELS:
        raise BadAnnotation(f"image_size must be from 1 to {MOST_PIXELS:,} pixels, not {plain['image_size']}")
    if intrinsics.diagonal()[:2].min() < longer / EXTREME or np.abs(intrinsics).max() > longer * EXTREME:
        raise BadCamera(f"intrinsics of no camera: {plain['intrinsics']}")
    return Cameras(torch.from_numpy(pose).float(), torch.from_numpy(intrinsics).float(), (int(height), int(width)))


def described_up(settings: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the direction up in the settings of a description, or raise DataError if it has no usable length."""
    up = finite_array(settings.get("up", UP), (3,), "up")
    if not 1 / EXTREME < np.abs(up).max() < EXTREME:
        raise BadAnnotation(f"up must have a length, not {settings['up']}")
    return tuple(up.tolist())


def made_from(settings: Mapping[str, Any], files: Sequence[Path], weights_sum: str | None) -> str:
    """Return a digest of what a prediction depends on: the version, settings, and contents of all files.

    Args:
        files: the photo, and its mask if it has one.
        weights_sum: checksum of the weights.
    """
    content = [__version__, settings, [sha256_of(file) for file in files], weights_sum]
    return sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def finished_digest(folder: Path) -> str | None:
    """Return what the prediction in a folder was `made_from`, or None if there is none or a file of it is missing."""
    try:
        description = read_json(folder / SCENE_FILE)
        names = field(description, "files", dict)
        digest = field(field(description, "settings", dict), "made_from", str)
    except DataError:
        return None
    return digest if all(os.path.isfile(folder / str(name)) for name in names.values()) else None
