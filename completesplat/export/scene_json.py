"""The description that travels with a generated splat: camera, conventions, settings."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from completesplat.export.atomic import atomic_path
from completesplat.geometry.cameras import Cameras

CONVENTIONS = {
    "axes": "OpenCV: +x right, +y down, +z forward, seen from the reference camera",
    "world_to_camera": "4 x 4, rows first; maps homogeneous world points (as columns) to camera points",
    "intrinsics": "3 x 3, rows first, in pixels; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)",
    "image_size": "(height, width) in pixels",
    "units": "the data set's or model's own scale; not metres",
    "quaternions": "(w, x, y, z), unit length",
    "colors": "sRGB, 0 to 1, the same from every direction",
}


def write_scene_json(
    path: str | Path, reference: Cameras, settings: Mapping[str, Any], seed: int, files: Mapping[str, str]
) -> None:
    """Write the scene description as plain JSON; the file appears whole or not at all.

    Args:
        path: the file.
        reference: the reference camera, unbatched.
        settings: what the scene was made with, as plain values.
        seed: of the random numbers.
        files: what each file beside this one is called, by purpose.

    Raises:
        ValueError: a number that is not finite (JSON has none).
        TypeError: a setting that JSON cannot express.
    """
    camera = {
        "world_to_camera": reference.world_to_camera.tolist(),
        "intrinsics": reference.intrinsics.tolist(),
        "image_size": list(reference.image_size),
    }
    scene = {
        "format": "completesplat scene 1",
        "reference_camera": camera,
        "conventions": CONVENTIONS,
        "settings": dict(settings),
        "seed": seed,
        "files": dict(files),
    }
    text = json.dumps(scene, indent=2, allow_nan=False, ensure_ascii=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
