"""Common form of captures, independent of their files and conventions, and undistorted reading of their images."""

import logging
import re
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from completesplat.data.images.exif import ORIENTATION, read_exif
from completesplat.data.images.files import (
    EIGHT_BIT_MODES,
    FORMATS,
    check_annotated_size,
    check_sums,
    decode,
    opened,
    over_grey,
    refused_as_bad,
)
from completesplat.data.sequences import shortened
from completesplat.data.validation import LARGEST, BadAnnotation, BadCamera, TooFewFrames, at, require_file
from completesplat.errors import CompleteSplatError, ImageError
from completesplat.geometry.cameras import Cameras

if TYPE_CHECKING:
    from pycolmap import Camera

logger = logging.getLogger(__name__)

FEWEST_FRAMES = 6
# Limits for an undistorted image's area and sides, relative to the distorted image's. Wrong coefficients exceed them.
SMALLEST_AREA, LARGEST_SIDE = 0.5, 2.0


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels with OpenCV's distortion; the outer corner of the top left pixel is at (0, 0)."""

    focal: tuple[float, float]  # along x and y
    center: tuple[float, float]  # the principal point (x, y)
    image_size: tuple[int, int]  # (height, width)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3

    def __post_init__(self) -> None:
        (height, width), (x, y) = self.image_size, self.center
        if not (np.abs([*self.focal, *self.center, *self.distortion]) < LARGEST).all():
            raise BadCamera(f"intrinsics are not finite: {self.focal}, {self.center}, {self.distortion}")
        if min(height, width) <= 0 or min(self.focal) <= 0:
            raise BadCamera(f"sizes and focal lengths must be positive, not {width} x {height} and {self.focal}")
        if not (0 < x < width and 0 < y < height):
            raise BadCamera(f"principal point ({x:g}, {y:g}) lies outside of the {width} x {height} image")


@dataclass(frozen=True)
class CapturedFrame:
    """One image of a capture, with its number in the capture's own file and its pose in OpenCV's convention."""

    number: int
    image: Path
    mask: Path | None
    lens: Lens
    world_to_camera: Float[np.ndarray, "4 4"]

    def camera(self) -> Cameras:
        """Return the pinhole camera (float64) of the undistorted image; errors as in `undistorted_lens`."""
        with at(self.image, frame=self.number):
            lens = undistorted_lens(self.lens)
        (fx, fy), (x, y) = lens.focal, lens.center
        intrinsics = torch.tensor([[fx, 0, x], [0, fy, y], [0, 0, 1]], dtype=torch.float64)
        return Cameras(torch.from_numpy(self.world_to_camera), intrinsics, lens.image_size)

    def read(self) -> tuple[Image.Image, Image.Image]:
        """Return the undistorted RGB image and its mask: of the mask file, else the alpha channel, else white.

        Raises:
            DataError: a file is missing, unusable or of another size, or its EXIF orientation turns the image.
        """
        with at(self.image, frame=self.number):
            image, mask = _read_upright(self.image, self.lens.image_size)
            if self.mask is not None:
                mask = decode(self.mask, str(self.mask), "L", self.lens.image_size)
            image = undistort(image, self.lens)
            return image, Image.new("L", image.size, 255) if mask is None else undistort(mask, self.lens)


@dataclass(frozen=True)
class Capture:
    """Frames of one capture in the order of their file names.

    Attributes:
        files: files of the cameras and points.
        points: in the world of the poses; None if there are none.
    """

    files: tuple[Path, ...]
    frames: tuple[CapturedFrame, ...]
    points: Float[np.ndarray, "n 3"] | None


def in_order(frames: Sequence[CapturedFrame]) -> tuple[CapturedFrame, ...]:
    """Sort frames by file name, `r_2` before `r_10`; refuse fewer than 6 frames, or an image that occurs twice."""
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"{len(frames)} frames; a capture needs at least {FEWEST_FRAMES}")
    seen: dict[Path, int] = {}
    for frame in frames:
        first = seen.setdefault(frame.image.resolve(), frame.number)
        if first != frame.number:
            raise BadAnnotation(f"the same image as frame {first}: {frame.image}", frame=frame.number)

    def key(frame: CapturedFrame) -> list[tuple[int, str]]:
        parts = re.split(r"([0-9]+)", str(frame.image))
        return [(len(part), part) if part.isdecimal() else (-1, part) for part in parts]

    return tuple(sorted(frames, key=key))


def warn_of_missing(path: Path, missing: Sequence[str], frames: int) -> None:
    """Name the images that the file at `path` lists, in `frames` frames, and that are not there."""
    if missing:
        counted = f"{len(missing)} of {frames} frames have no image and are left out"
        logger.warning("%s: %s: %s", path, counted, shortened(missing))


def _read_upright(path: Path, image_size: tuple[int, int]) -> tuple[Image.Image, Image.Image | None]:
    """Return the RGB image over white, and its opacity if it has transparency data.

    Alpha is straight and mixed in sRGB, as in the images of NeRF (synthetic). An EXIF orientation is refused, because
    programs that estimate poses use the pixels as they are stored, so the pose would not fit the upright image.
    """
    require_file(path)
    with refused_as_bad(str(path)), opened(path, FORMATS) as image:
        orientations = {read_exif(image).get(ORIENTATION)}  # Decoding a TIFF removes its orientation.
        check_sums(image, path)
        image.load()
        orientations.add(read_exif(image).get(ORIENTATION))
        if turned := orientations - {None, 0, 1}:
            raise ImageError(
                f"is to be turned (EXIF orientation {turned.pop()}), its camera's pose is not: save the pixels "
                "as the pose sees them, without that tag"
            )
        if image.has_transparency_data and image.mode in EIGHT_BIT_MODES:
            check_annotated_size(image, image_size)
            return over_grey(image, 1.0), image.convert("RGBA").getchannel("A")
    return decode(path, str(path), "RGB", image_size), None


def undistorted_lens(lens: Lens) -> Lens:
    """Return the pinhole lens of undistorted images, which are larger or smaller and show no unseen pixels.

    Raises:
        CompleteSplatError: the lens distorts, and pycolmap is missing.
        BadCamera: the distortion leaves no usable image.
    """
    if not any(lens.distortion):
        return lens
    pycolmap, (height, width) = import_pycolmap(), lens.image_size
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), _distorted(lens))
    size = pinhole.height, pinhole.width
    sides = size[0] / height, size[1] / width
    if sides[0] * sides[1] < SMALLEST_AREA or max(sides) >= LARGEST_SIDE:
        raise BadCamera(f"distortion {lens.distortion} leaves no usable image")
    fx, fy, x, y = map(float, pinhole.params)
    return replace(lens, focal=(fx, fy), center=(x, y), image_size=size, distortion=(0.0,) * 5)


def undistort(image: Image.Image, lens: Lens) -> Image.Image:
    """Return the image of `undistorted_lens`, resampled bilinearly."""
    if not any(lens.distortion):
        return image
    pycolmap = import_pycolmap()
    options, bitmap = pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(np.array(image))
    return Image.fromarray(pycolmap.undistort_image(options, bitmap, _distorted(lens))[0].to_array())


def import_pycolmap() -> ModuleType:
    """Import pycolmap without its handler of SIGTERM, which ends a program before it has cleared up."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError:
        message = 'lenses with distortion and cameras=colmap need pycolmap: pip install "completesplat[colmap]"'
        raise CompleteSplatError(message) from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def _distorted(lens: Lens) -> "Camera":
    (height, width), params = lens.image_size, [*lens.focal, *lens.center, *lens.distortion, 0.0, 0.0, 0.0]
    camera: Camera = import_pycolmap().Camera(model="FULL_OPENCV", width=width, height=height, params=params)
    return camera
