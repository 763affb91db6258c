"""Scenes that the page shows, with the cameras that they belong to."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.data.validation import field, read_json
from completesplat.errors import CompleteSplatError, errors_at
from completesplat.export.cleaning import with_screen_space_dilation
from completesplat.export.description import SCENE_FILE, UP, described_camera, described_up, is_described
from completesplat.export.prediction import PHOTO_FILE
from completesplat.export.reading import read_gaussians
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project
from completesplat.photo.files import open_image, refused_as_bad
from completesplat.wording import by_numbers

NEWEST_FILE = "scenes.json"
MOST_LAYERS = 16
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


def read_stored_photo(scene: Path, longest: int) -> UInt8[np.ndarray, "_ _ 3"] | None:
    """Return a prediction's photo, no longer than so many pixels, or None if the folder of the scene has none.

    Raises:
        BadImage: it is damaged.
    """
    folder = scene if scene.is_dir() else scene.parent
    file = folder / PHOTO_FILE
    if not (file.is_file() and is_described(folder)):
        return None
    with refused_as_bad(str(file)), open_image(file, ("PNG",)) as image:
        image.thumbnail((longest, longest))
        return np.asarray(image.convert("RGB"))


def read_scene(path: Path) -> tuple[list[Sample], tuple[float, ...]]:
    """Read the scene in a file, or all samples of a prediction or fitted scene, and the direction up.

    A file without our `scene.json` beside it is seen by its `framing_camera`.

    Raises:
        CompleteSplatError: there is nothing that can be shown.
    """
    if path.is_file():
        folder = path.parent
        files = [path]
    else:
        folder = path
        files = sorted([*path.glob("sample_*.ply"), *path.glob("scene.ply")], key=by_numbers)
    if not files:
        raise CompleteSplatError(f"{path}: no sample_*.ply or scene.ply in this folder")
    scenes = [read_gaussians(file) for file in files]
    named_by_us = all(file.name.startswith(("sample_", "scene.")) for file in files)
    if not named_by_us or not is_described(folder):
        return [Sample(scene, 1, framing_camera(scene)) for scene in scenes], UP
    with errors_at(folder / SCENE_FILE):
        data = read_json(folder / SCENE_FILE)
        reference = described_camera(data)
        settings = field(data, "settings", dict)
        up = described_up(settings)
    return [Sample(scene, _layers(scene, reference), reference, settings) for scene in scenes], up


def read_newest(folder: Path) -> tuple[int, list[Sample], tuple[float, ...]]:
    """Return a run's newest step, its scenes and the direction up, as `write_newest` wrote them.

    Raises:
        CompleteSplatError: they cannot be read.
    """
    path = folder / NEWEST_FILE
    samples = []
    with errors_at(path):
        data = read_json(path)
        step = field(data, "step", int)
        up = described_up(data)
        for row in field(data, "scenes", list):
            camera = described_camera(row)
            settings = {"scene": field(row, "scene", str), "step": step}
            scene = read_gaussians(folder / Path(field(row, "file", str)).name)
            samples.append(Sample(scene, _layers(scene, camera), camera, settings))
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
