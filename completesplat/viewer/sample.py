"""What the page shows: scenes with the camera that they belong to."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import with_screen_space_dilation
from completesplat.export.ply import read_ply
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project

UP = (0.0, -1.0, 0.0)
NEWEST_FILE = "scenes.json"
FRAMING_FOV, FRAMING_SIZE = 50.0, 512


@dataclass(frozen=True)
class Sample:
    """One scene, unbatched.

    Attributes:
        layers: M of the splatter image that it was, or 1.
        reference: the camera of its photograph, or one that sees all of it.
        settings: what it was drawn with, for the files that are saved.
        finished: False for an estimate on the way.
        exact: as the model gives it, for our rasterizers; files hold Gaussians with screen-space dilation already.
    """

    gaussians: Gaussians
    layers: int
    reference: Cameras
    settings: Mapping[str, Any] = field(default_factory=dict)
    finished: bool = True
    exact: bool = False

    def for_viewers(self) -> Gaussians:
        """With screen-space dilation once: what the page draws and what is stored."""
        return with_screen_space_dilation(self.gaussians, self.reference) if self.exact else self.gaussians

    def pivot(self) -> Float[Tensor, "3"]:
        """On the optical axis, at the median depth (by opacity) of the Gaussians in the picture's central ninth."""
        kept = self.gaussians.keep(self.gaussians.finite())
        pixels, depths = project(self.reference, kept.means)
        height, width = self.reference.image_size
        offset = pixels / torch.tensor([width, height], device=pixels.device) - 0.5
        seen = (depths > 0) & (offset.abs() < 1 / 6).all(-1)
        if not seen.any():
            seen = depths > 0
        ordered, order = depths[seen].sort()
        weights = kept.opacities[seen][order].cumsum(0)
        depth = ordered[(weights < weights[-1] / 2).sum()].item() if len(ordered) else 1.0
        return self.reference.centers + self.reference.camera_to_world[:3, 2] * depth


def read_scene(path: Path) -> tuple[list[Sample], tuple[float, ...]]:
    """A `.ply`, or the folder of a prediction with all its samples, or of a fitted scene; and where up is.

    Without the prediction's `scene.json` beside it, a file is looked at by its `framing_camera`. `CompleteSplatError`:
    nothing there that can be shown.
    """
    files = [path] if path.is_file() else sorted([*path.glob("sample_*.ply"), *path.glob("scene.ply")])
    if not files:
        raise CompleteSplatError(f"{path}: no sample_*.ply or scene.ply in this folder")
    scenes = [read_ply(file) for file in files]
    description = (path.parent if path.is_file() else path) / "scene.json"
    if not description.is_file() or not all(file.name.startswith(("sample_", "scene.")) for file in files):
        return [Sample(scene, 1, framing_camera(scene)) for scene in scenes], UP
    reference, settings = _read_description(description)
    return [Sample(scene, _layers(scene, reference), reference, settings) for scene in scenes], _up(settings)


def read_newest(folder: Path) -> tuple[int, list[Sample], tuple[float, ...]]:
    """The fixed scenes that a run has written last (`write_newest`), with the step, and where up is.

    `CompleteSplatError`: they cannot be read.
    """
    path = folder / NEWEST_FILE
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        step, up = int(found["step"]), _up(found)
        described = [(str(one["file"]), str(one["scene"]), _camera(one["reference_camera"])) for one in found["scenes"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CompleteSplatError(f"{path}: not the newest scenes of a run") from error
    samples = []
    for file, name, camera in described:
        scene = read_ply(folder / Path(file).name)
        samples.append(Sample(scene, _layers(scene, camera), camera, {"scene": name, "step": step}))
    return step, samples, up


def framing_camera(gaussians: Gaussians) -> Cameras:
    """A camera that looks along +z at nine tenths of the Gaussians."""
    means = gaussians.means if gaussians.count else torch.zeros(1, 3)
    center = means.median(dim=0).values
    # Sorted, as `torch.quantile` refuses more than 16 million values.
    distances = (means - center).norm(dim=-1).sort().values
    radius = distances[int(0.9 * (len(distances) - 1))].clamp(min=1e-3)
    back = 1.1 * radius / torch.tensor(FRAMING_FOV / 2).deg2rad().sin()
    eye = center - torch.tensor([0.0, 0.0, 1.0]) * back
    intrinsics = pinhole(FRAMING_FOV, FRAMING_SIZE)
    return Cameras(look_at(eye, center, torch.tensor(UP)), intrinsics, (FRAMING_SIZE, FRAMING_SIZE))


def _layers(gaussians: Gaussians, reference: Cameras) -> int:
    """Gaussians that could not be written are missing from a file: then its layers are not known."""
    layers, rest = divmod(gaussians.count, math.prod(reference.image_size))
    return layers if layers and not rest else 1


def _up(settings: Mapping[str, Any]) -> tuple[float, ...]:
    x, y, z = settings.get("up", UP)
    return float(x), float(y), float(z)


def _camera(plain: Mapping[str, Any]) -> Cameras:
    pose, intrinsics = (torch.tensor(plain[name]).float() for name in ("world_to_camera", "intrinsics"))
    height, width = plain["image_size"]
    if (pose.shape, intrinsics.shape) != ((4, 4), (3, 3)):
        raise ValueError("matrices of other sizes")
    return Cameras(pose, intrinsics, (int(height), int(width)))


def _read_description(path: Path) -> tuple[Cameras, dict[str, Any]]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        camera, settings = _camera(found["reference_camera"]), dict(found["settings"])
        _up(settings)
        return camera, settings
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CompleteSplatError(f"{path}: not the description of a prediction") from error
