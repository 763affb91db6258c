"""What a capture is, once its own files and conventions are behind it: pictures, lenses, poses, points."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from completesplat.data.checks import BadAnnotation, BadCamera, TooFewFrames, at

FEWEST_FRAMES = 6


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels with OpenCV's distortion; (0, 0) is the corner of the top left pixel, its centre (0.5, 0.5).

    Attributes:
        focal: along x and y.
        center: the principal point (x, y).
        image_size: (height, width).
        distortion: k1, k2, p1, p2, k3 (OpenCV's order).
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    image_size: tuple[int, int]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsics as a matrix, without the distortion."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@dataclass(frozen=True)
class CapturedFrame:
    """One picture of a capture, with OpenCV's pose (+x right, +y down, +z forward).

    Attributes:
        number: what the capture's own file calls it; for refusals.
    """

    number: int
    image: Path
    mask: Path | None
    lens: Lens
    world_to_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class PointCloud:
    """Points in the world of the poses, with their sRGB colours."""

    points: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Capture:
    """The frames of one capture, in the order of their file names (numbers in them by value).

    Attributes:
        name: of the folder it lies in.
        file: where its cameras come from; for refusals.
    """

    name: str
    file: Path
    frames: tuple[CapturedFrame, ...]
    cloud: PointCloud | None


def in_order(frames: Sequence[CapturedFrame]) -> tuple[CapturedFrame, ...]:
    """The frames by file name.

    Raises:
        TooFewFrames: fewer than 6.
        BadAnnotation: a picture is there twice.
    """
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"{len(frames)} frames; a capture needs at least {FEWEST_FRAMES}")
    seen: dict[Path, int] = {}
    for frame in frames:
        first = seen.setdefault(frame.image.resolve(), frame.number)
        if first != frame.number:
            raise BadAnnotation(f"the same picture as frame {first}: {frame.image}", frame=frame.number)
    return tuple(sorted(frames, key=lambda frame: _natural(str(frame.image))))


def check_lens(lens: Lens) -> Lens:
    """The lens itself.

    Raises:
        BadCamera: a size or focal length that is not positive, numbers that are not finite, or a principal point
            outside of the picture.
    """
    (height, width), (x, y) = lens.image_size, lens.center
    if not np.isfinite([*lens.focal, *lens.center, *lens.distortion]).all():
        raise BadCamera(f"intrinsics are not finite: {lens.focal}, {lens.center}, {lens.distortion}")
    if min(height, width) <= 0 or min(lens.focal) <= 0:
        raise BadCamera(f"sizes and focal lengths must be positive, not {width} x {height} and {lens.focal}")
    if not (0 < x < width and 0 < y < height):
        raise BadCamera(f"principal point ({x:g}, {y:g}) lies outside of the {width} x {height} picture")
    return lens


def make_cloud(points: Any, colors: Any, file: Path) -> PointCloud | None:
    """A point cloud, or None if there are no points.

    Raises:
        BadAnnotation: coordinates that are not finite.
    """
    if not len(points):
        return None
    with at(file):
        if not np.isfinite(points).all():
            raise BadAnnotation("points that are not finite")
    return PointCloud(np.asarray(points, dtype=np.float64), np.asarray(colors, dtype=np.uint8))


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts `r_2` before `r_10`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", name)]
