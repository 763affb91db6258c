"""What a capture is, once its own files and conventions are behind it, and its pictures."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from completesplat.data.pictures.exif import ORIENTATION, read_exif
from completesplat.data.pictures.files import (
    EIGHT_BIT_MODES,
    FORMATS,
    MOST_PIXELS,
    check_pixels,
    damage_refused,
    decode,
)
from completesplat.data.validation import BadAnnotation, BadCamera, BadPicture, TooFewFrames, at, require_file
from completesplat.errors import ImageError

FEWEST_FRAMES = 6
PNG_BIT_DEPTH = 24  # byte of the file


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


class CapturedPicture(NamedTuple):
    """A decoded picture.

    Attributes:
        image: RGB; transparency is laid over white.
        alpha: its opacity (grey), if it has transparency data.
        lossy: it was a JPEG.
        plain: the file is a JPEG or PNG of just these 8-bit RGB pixels.
    """

    image: Image.Image
    alpha: Image.Image | None
    lossy: bool
    plain: bool


def read_picture(path: Path, image_size: tuple[int, int]) -> CapturedPicture:
    """Decode a picture of (height, width). Alpha is straight and mixed in sRGB, as in the pictures of NeRF (synthetic).

    Raises:
        MissingFile: no such file.
        BadPicture: damaged, too large, of another size, or to be turned by its EXIF orientation: the programs that
            estimate poses look at the pixels as they are stored, so that pose and upright picture do not agree.
    """
    require_file(path)
    try:
        with damage_refused(FORMATS, MOST_PIXELS), Image.open(path, formats=FORMATS) as picture:
            check_pixels(picture, MOST_PIXELS)
            orientations = {read_exif(picture).get(ORIENTATION)}  # A TIFF loses its own when it is decoded.
            if picture.format == "PNG":
                _check_sums(path)
            picture.load()
            orientations.add(read_exif(picture).get(ORIENTATION))
            if turned := orientations - {None, 0, 1}:
                raise ImageError(
                    f"is to be turned (EXIF orientation {turned.pop()}), its camera's pose is not: save the pixels "
                    "as the pose sees them, without that tag"
                )
            lossy, plain = picture.format in ("JPEG", "MPO"), _is_plain(path, picture)
            if picture.has_transparency_data and picture.mode in EIGHT_BIT_MODES:
                _check_size(picture.size, image_size)
                return CapturedPicture(*_over_white(picture.convert("RGBA")), lossy, plain=False)
    except ImageError as error:
        raise BadPicture(str(error), str(path)) from error.__cause__
    return CapturedPicture(decode(path, str(path), "RGB", image_size), None, lossy, plain)


def picture_size(path: Path) -> tuple[int, int]:
    """(height, width) of a picture file, by its header.

    Raises:
        MissingFile: no such file.
        BadPicture: no picture.
    """
    try:
        with damage_refused(FORMATS, MOST_PIXELS), Image.open(require_file(path), formats=FORMATS) as picture:
            return picture.height, picture.width
    except ImageError as error:
        raise BadPicture(str(error), str(path)) from error.__cause__


def _over_white(picture: Image.Image) -> tuple[Image.Image, Image.Image]:
    white = Image.new("RGBA", picture.size, "white")
    return Image.alpha_composite(white, picture).convert("RGB"), picture.getchannel("A")


def _check_sums(path: Path) -> None:
    with Image.open(path, formats=FORMATS) as again:
        again.verify()


def _check_size(size: tuple[int, int], image_size: tuple[int, int]) -> None:
    if size != image_size[::-1]:
        raise ImageError(f"has {size[1]} x {size[0]} pixels, its annotation says {image_size[0]} x {image_size[1]}")


def _is_plain(path: Path, picture: Image.Image) -> bool:
    if picture.mode != "RGB" or picture.format not in ("JPEG", "PNG") or picture.has_transparency_data:
        return False
    with path.open("rb") as file:
        return picture.format == "JPEG" or file.read(PNG_BIT_DEPTH + 1)[-1] == 8
