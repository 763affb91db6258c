"""Scenes that the page shows, with the cameras that they belong to."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.images.files import MOST_PIXELS
from completesplat.data.validation import field, finite_array, read_json, require_rotation
from completesplat.errors import BadAnnotation, BadCamera, CompleteSplatError, errors_at
from completesplat.export.cleaning import LARGEST, with_screen_space_dilation
from completesplat.export.prediction import SCENE_FILE, is_described
from completesplat.export.reading import read_gaussians
from completesplat.files import by_numbers
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project

UP = (0.0, -1.0, 0.0)
NEWEST_FILE = "scenes.json"
MOST_LAYERS = 16
EXTREME = 1e6  # ratio of focal length and image, and length of the direction up
FRAMING_FOV = 50.0
FRAMING_SIZE = 512


@dataclasses.dataclass(frozen=True)
class Sample:
    """One scene, unbatched.

    Attributes:
        layers: number of layers (M) of its splatter image, or 1.
        reference: camera of its photo, or its `framing_camera`.
        settings: settings that it was drawn with, which are recorded in saved files.
        finished: False for an intermediate estimate.
        exact: whether the Gaussians are the model's own; those of files already have screen-space dilation.
    """

    gaussians: Gaussians
    layers: int
    reference: Cameras
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    finished: bool = True
    exact: bool = False

    def for_viewers(self) -> Gaussians:
        """Return the Gaussians with screen-space dilation, for the page and for files."""
        return with_screen_space_dilation(self.gaussians, self.reference) if self.exact else self.gaussians

    def pivot(self) -> Float[Tensor, "3"]:
        """Return the point on the optical axis at the median depth, by opacity, of the image's central ninth."""
        finite = self.gaussians[self.gaussians.finite()]
        pixels, depths = project(self.reference, finite.means)
        height, width = self.reference.image_size
        offset = pixels / torch.tensor([width, height], device=pixels.device) - 0.5
        mask = (depths > 0) & (offset.abs() < 1 / 6).all(-1)
        if not mask.any():
            mask = depths > 0
        ordered, order = depths[mask].sort()
        weights = finite.opacities[mask][order].cumsum(0)
        depth = ordered[(weights < weights[-1] / 2).sum()].item() if len(ordered) else 1.0
        return self.reference.centers + self.reference.camera_to_world[:3, 2] * depth


def read_scene(path: Path) -> tuple[list[Sample], tuple[float, ...]]:
    """Read a file of Gaussians, or all samples of a prediction or fitted scene; return them and the direction up.

    A file without our `scene.json` beside it is seen by its `framing_camera`.

    Raises:
        CompleteSplatError: there is nothing that can be shown.
    """
    files = [path] if path.is_file() else sorted([*path.glob("sample_*.ply"), *path.glob("scene.ply")], key=by_numbers)
    if not files:
        raise CompleteSplatError(f"{path}: no sample_*.ply or scene.ply in this folder")
    scenes = [read_gaussians(file) for file in files]
    description = (path.parent if path.is_file() else path) / SCENE_FILE
    is_ours = all(file.name.startswith(("sample_", "scene.")) for file in files) and is_described(description.parent)
    if not is_ours:
        return [Sample(scene, 1, framing_camera(scene)) for scene in scenes], UP
    with errors_at(description):
        data = read_json(description)
        reference = _camera(field(data, "reference_camera", dict))
        settings = field(data, "settings", dict)
        up = _up(settings)
    return [Sample(scene, _layers(scene, reference), reference, settings) for scene in scenes], up


def read_newest(folder: Path) -> tuple[int, list[Sample], tuple[float, ...]]:
    """Return a run's newest step, scenes and direction up (`write_newest`); raise CompleteSplatError if unreadable."""
    path = folder / NEWEST_FILE
    samples = []
    with errors_at(path):
        data = read_json(path)
        step = field(data, "step", int)
        up = _up(data)
        for row in field(data, "scenes", list):
            camera = _camera(field(row, "reference_camera", dict))
            settings = {"scene": field(row, "scene", str)}
            scene = read_gaussians(folder / Path(field(row, "file", str)).name)
            samples.append(Sample(scene, _layers(scene, camera), camera, settings | {"step": step}))
    return step, samples, up


def framing_camera(gaussians: Gaussians) -> Cameras:
    """Return a camera that looks along +z and sees nine tenths of the Gaussians."""
    means = gaussians.means if gaussians.count else torch.zeros(1, 3)
    center = means.median(dim=0).values
    # Sorted, because `torch.quantile` refuses more than 16 million values.
    distances = (means - center).norm(dim=-1).sort().values
    radius = distances[int(0.9 * (len(distances) - 1))].clamp(min=1e-3)
    back = 1.1 * radius / torch.tensor(FRAMING_FOV / 2).deg2rad().sin()
    eye = center - torch.tensor([0.0, 0.0, 1.0]) * back
    return Cameras(look_at(eye, center, torch.tensor(UP)), pinhole(FRAMING_FOV, FRAMING_SIZE), (FRAMING_SIZE,) * 2)


def _layers(gaussians: Gaussians, reference: Cameras) -> int:
    """Return the number of layers, or 1 if it is unknown because Gaussians were left out of the file."""
    layers, rest = divmod(gaussians.count, math.prod(reference.image_size))
    return layers if 1 <= layers <= MOST_LAYERS and not rest else 1


def _up(settings: Mapping[str, Any]) -> tuple[float, ...]:
    up = finite_array(settings.get("up", UP), (3,), "up")
    if not 1 / EXTREME < np.abs(up).max() < EXTREME:
        raise BadAnnotation(f"up must have a length, not {settings['up']}")
    return tuple(up.tolist())


def _camera(plain: Mapping[str, Any]) -> Cameras:
    """Convert a camera of a description; raise DataError for one that cannot be."""
    pose = finite_array(plain.get("world_to_camera"), (4, 4), "world_to_camera")
    intrinsics = finite_array(plain.get("intrinsics"), (3, 3), "intrinsics")
    height, width = size = finite_array(plain.get("image_size"), (2,), "image_size").tolist()
    require_rotation(pose[:3, :3], "world_to_camera")
    if np.abs(pose).max() > LARGEST:
        raise BadCamera(f"world_to_camera is farther than {LARGEST:g} from the origin")
    if not 1 <= min(size) <= height * width <= MOST_PIXELS:
        raise BadAnnotation(f"image_size must be from 1 to {MOST_PIXELS:,} pixels, not {plain['image_size']}")
    relative = np.abs(intrinsics) / max(size)
    if intrinsics.diagonal()[:2].min() < max(size) / EXTREME or relative.max() > EXTREME:
        raise BadCamera(f"intrinsics of no camera: {plain['intrinsics']}")
    return Cameras(torch.from_numpy(pose).float(), torch.from_numpy(intrinsics).float(), (int(height), int(width)))
