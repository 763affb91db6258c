"""One scene as an HTML page that needs nothing else: the viewer of SuperSplat with the splats inside."""

import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.export.ply import write_ply
from completesplat.export.splat_transform import SplatTransform
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points

WIDEST_WINDOW = 16 / 9
LARGEST_FOV = 120.0


@dataclass(frozen=True)
class PageView:
    """Where a page begins: at the reference camera (unbatched), turning about a point, before a grey background."""

    reference: Cameras
    pivot: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    background: float


def write_page(path: Path, gaussians: Gaussians, view: PageView, converter: SplatTransform) -> None:
    """Write the page: the scene upright, seen from the front, turning until somebody touches it.

    Raises:
        CompleteSplatError: nothing to show, or the converter fails.
    """
    turn = upright(view.up)
    with tempfile.TemporaryDirectory() as folder:
        scene, settings = Path(folder) / "scene.ply", Path(folder) / "settings.json"
        write_ply(scene, gaussians.transform(turn))
        settings.write_text(json.dumps(viewer_settings(view, turn)))
        converter.convert(scene, path, ["--viewer-settings", str(settings)])


def upright(up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The rotation that makes `up` point to -y, as the viewer expects it of a file, and keeps forward in front."""
    down = -torch.nn.functional.normalize(up, dim=-1)
    axes = torch.eye(3, dtype=up.dtype, device=up.device)
    # Where the camera looks straight down or up, any direction may be the front.
    ahead = axes[2] if down[2].abs() < 0.99 else axes[1]
    right = torch.nn.functional.normalize(torch.linalg.cross(down, ahead), dim=-1)
    matrix = torch.eye(4, dtype=up.dtype, device=up.device)
    matrix[:3, :3] = torch.stack([right, down, torch.linalg.cross(right, down)])
    return matrix


def viewer_settings(view: PageView, turn: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """Settings of the viewer (its schema, version 2).

    It turns a file by 180 degrees about z, so that +y comes to point up; its camera is placed after that. Its field of
    view is that of the window's longer side: wide enough for the shorter one to hold what the photograph shows.
    """
    points = torch.stack([view.reference.centers, view.pivot])
    flip = torch.tensor([-1.0, -1.0, 1.0], dtype=points.dtype, device=points.device)
    position, target = (transform_points(turn, points) * flip).tolist()
    half = max(view.reference.image_size) / 2 / view.reference.intrinsics[0, 0].item()
    fov = min(LARGEST_FOV, math.degrees(2 * math.atan(half * WIDEST_WINDOW)))
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [view.background] * 3},
        "postEffectSettings": {
            "sharpness": {"enabled": False, "amount": 0},
            "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
            "grading": {"enabled": False, "brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {"enabled": False, "intensity": 0.5},
        },
        "animTracks": [],
        "cameras": [{"initial": {"position": position, "target": target, "fov": fov}}],
        "annotations": [],
        "startMode": "default",
    }
