"""Common form of captures, independent of their files and conventions, and reading of their images."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from completesplat.data.images.exif import ORIENTATION, read_exif
from completesplat.data.images.files import (
    EIGHT_BIT_MODES,
    FORMATS,
    check_annotated_size,
    check_sums,
    decode,
    opened,
    over_white,
    refused_as_bad,
)
from completesplat.data.validation import BadAnnotation, BadCamera, TooFewFrames, require_file
from completesplat.errors import ImageError

FEWEST_FRAMES = 6
PNG_BIT_DEPTH = 24  # index of the byte in the file


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels with OpenCV's distortion; the outer corner of the top left pixel is at (0, 0)."""

    focal: tuple[float, float]  # along x and y
    center: tuple[float, float]  # the principal point (x, y)
    image_size: tuple[int, int]  # (height, width)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3


@dataclass(frozen=True)
class CapturedFrame:
    """One image of a capture, with its number in the capture's own file and its pose in OpenCV's convention."""

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
    """Frames of one capture in the order of their file names, the name of its folder, and the file of its cameras."""

    name: str
    file: Path
    frames: tuple[CapturedFrame, ...]
    cloud: PointCloud | None


def in_order(frames: Sequence[CapturedFrame]) -> tuple[CapturedFrame, ...]:
    """Sort frames by file name, and refuse fewer than 6 frames or an image that occurs twice."""
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"{len(frames)} frames; a capture needs at least {FEWEST_FRAMES}")
    seen: dict[Path, int] = {}
    for frame in frames:
        first = seen.setdefault(frame.image.resolve(), frame.number)
        if first != frame.number:
            raise BadAnnotation(f"the same picture as frame {first}: {frame.image}", frame=frame.number)
    return tuple(sorted(frames, key=lambda frame: _natural(str(frame.image))))


def check_lens(lens: Lens) -> Lens:
    """Return the lens itself, if it is valid.

    Raises:
        BadCamera: a size or focal length is not positive, a number is not finite, or the principal point is outside.
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
    """Return a point cloud, or None if there are no points; refuse coordinates that are not finite."""
    if not len(points):
        return None
    if not np.isfinite(points).all():
        raise BadAnnotation("points that are not finite", str(file))
    return PointCloud(np.asarray(points, dtype=np.float64), np.asarray(colors, dtype=np.uint8))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sorting key that puts `r_2` before `r_10`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", name)]


class CapturedPicture(NamedTuple):
    """Decoded RGB image, composited over white, and its opacity (grey) if it has transparency data.

    Attributes:
        lossy: whether the file is a JPEG.
        plain: whether the file is a JPEG or PNG with exactly these 8-bit RGB pixels.
    """

    image: Image.Image
    alpha: Image.Image | None
    lossy: bool
    plain: bool


def read_picture(path: Path, image_size: tuple[int, int]) -> CapturedPicture:
    """Decode an image of (height, width). Alpha is straight and mixed in sRGB, as in the images of NeRF (synthetic).

    Raises:
        MissingFile: the file does not exist.
        BadImage: it is damaged, too large, of another size, or its EXIF orientation turns it. Programs that estimate
            poses use the pixels as they are stored, so the pose would not fit the upright image.
    """
    require_file(path)
    with refused_as_bad(str(path)), opened(path, FORMATS) as picture:
        orientations = {read_exif(picture).get(ORIENTATION)}  # Decoding a TIFF removes its orientation.
        check_sums(picture, path)
        picture.load()
        orientations.add(read_exif(picture).get(ORIENTATION))
        if turned := orientations - {None, 0, 1}:
            raise ImageError(
                f"is to be turned (EXIF orientation {turned.pop()}), its camera's pose is not: save the pixels "
                "as the pose sees them, without that tag"
            )
        lossy, plain = picture.format in ("JPEG", "MPO"), _is_plain(path, picture)
        if picture.has_transparency_data and picture.mode in EIGHT_BIT_MODES:
            check_annotated_size(picture, image_size)
            alpha = picture.convert("RGBA").getchannel("A")
            return CapturedPicture(over_white(picture), alpha, lossy, plain=False)
    return CapturedPicture(decode(path, str(path), "RGB", image_size), None, lossy, plain)


def _is_plain(path: Path, picture: Image.Image) -> bool:
    if picture.mode != "RGB" or picture.format not in ("JPEG", "PNG") or picture.has_transparency_data:
        return False
    with path.open("rb") as file:
        return picture.format == "JPEG" or file.read(PNG_BIT_DEPTH + 1)[-1] == 8
