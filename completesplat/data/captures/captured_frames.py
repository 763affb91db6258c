"""Common form of captures, independent of their files and conventions, and undistorted reading of their images."""

import logging
import signal
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os.path import isfile, splitext
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from completesplat.data.sequences import first_names
from completesplat.data.validation import LARGEST, path_below, require_file
from completesplat.errors import BadAnnotation, BadCamera, BadImage, ImageError, TooFewFrames, errors_at, needing
from completesplat.geometry.cameras import Cameras
from completesplat.photo import files
from completesplat.photo.exif import ORIENTATION, TRANSPOSITIONS, read_exif
from completesplat.wording import by_numbers

if TYPE_CHECKING:
    from pycolmap import Camera

logger = logging.getLogger(__name__)

FEWEST_FRAMES = 6
SUFFIXES = (".png", ".jpg", ".jpeg")  # NeRF (synthetic) leaves the suffix out
SIDEWAYS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height
# Limits for an undistorted image's area and sides, relative to the distorted image's. Wrong coefficients exceed them.
SMALLEST_AREA = 0.5
LEAST_SIDE = 0.5  # of the largest square around the principal point, as a share of the image's shorter side
LARGEST_SIDE = 2.0


Listings = dict[Path, dict[str, str]]
"""Names of the files in folders by their names in small letters."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels with OpenCV's distortion, where the outer corner of the top left pixel is at (0, 0)."""

    focal: tuple[float, float]  # along x and y
    center: tuple[float, float]  # the principal point (x, y)
    image_size: tuple[int, int]  # (height, width)
    distortion: tuple[float, ...] = ()  # k1, k2, p1, p2, k3, k4, k5, k6 of OpenCV; those that are missing are 0

    def __post_init__(self) -> None:
        height, width = self.image_size
        x, y = self.center
        if not (np.abs([*self.focal, *self.center, *self.distortion]) < LARGEST).all():
            raise BadCamera(f"intrinsics are not finite: {self.focal}, {self.center}, {self.distortion}")
        if min(height, width) <= 0 or min(self.focal) <= 0:
            raise BadCamera(f"sizes and focal lengths must be positive, not {width} x {height} and {self.focal}")
        if not (0 < x < width and 0 < y < height):
            raise BadCamera(f"principal point ({x:g}, {y:g}) lies outside of the {width} x {height} image")
        if 2 * min(x, y, width - x, height - y) < LEAST_SIDE * min(height, width):
            place = f"principal point ({x:g}, {y:g}) lies near the edge of the {width} x {height} image"
            raise BadCamera(f"{place}: the intrinsics are of another size; give w and h of that size beside them")

    def resized(self, image_size: tuple[int, int]) -> "Lens":
        """Return the lens of images that are resized to (height, width)."""
        down = image_size[0] / self.image_size[0]
        across = image_size[1] / self.image_size[1]
        focal = (self.focal[0] * across, self.focal[1] * down)
        center = (self.center[0] * across, self.center[1] * down)
        return replace(self, focal=focal, center=center, image_size=image_size)


@dataclass(frozen=True)
class CapturedFrame:
    """One image of a capture, with its number in the capture's own file and its pose in OpenCV's convention.

    Programs that estimate poses, such as COLMAP, use the pixels as they are stored; others turn the image by its EXIF
    orientation first. The size of the lens says which image the pose is of.

    Attributes:
        orientation: of an image that has this size both ways, EXIF's is "ignored" (COLMAP) or "refused"; "unknown": the
            size says nothing, because it is the image's own.
    """

    number: int
    image: Path
    mask: Path | None
    lens: Lens
    world_to_camera: Float[np.ndarray, "4 4"]
    orientation: Literal["ignored", "refused", "unknown"] = "refused"

    def camera(self) -> Cameras:
        """Return the pinhole camera (float64) of the undistorted image, with the errors of `undistorted_lens`."""
        with errors_at(self.image, frame=self.number):
            lens = undistorted_lens(self.lens)
        fx, fy = lens.focal
        x, y = lens.center
        intrinsics = torch.tensor([[fx, 0, x], [0, fy, y], [0, 0, 1]], dtype=torch.float64)
        return Cameras(torch.from_numpy(self.world_to_camera), intrinsics, lens.image_size)

    def read(self) -> tuple[Image.Image, Image.Image]:
        """Return the undistorted RGB image and its mask: of the mask file, else the alpha channel, else white.

        Alpha is straight and mixed over white in sRGB, as in the images of NeRF (synthetic).

        Raises:
            DataError: a file is missing, unusable or of another aspect, or its EXIF orientation leaves two images.
        """
        with errors_at(self.image, frame=self.number):
            orientation = self.check()
            mask = None
            with files.refused_as_bad(str(self.image)), files.open_image(self.image, files.FORMATS) as stored:
                if stored.has_transparency_data and stored.mode in files.EIGHT_BIT_MODES:
                    files.check_sums(stored, self.image)
                    stored.load()
                    turned = files.turn_upright(stored, orientation)
                    image = files.over_grey(files.in_srgb(turned), 1.0)
                    mask = turned.convert("RGBA").getchannel("A")
            if mask is None:
                turn = orientation is not None
                image = files.decode_image(self.image, str(self.image), "RGB", self.lens.image_size, turn, True)
            if self.mask is not None:
                mask = files.decode_image(self.mask, str(self.mask), "L")
                mask = mask.resize(image.size, Image.Resampling.BILINEAR)
            image = undistort(image, self.lens)
            if mask is None:
                return image, Image.new("L", image.size, 255)
            return image, undistort(mask, self.lens)

    def is_hidden(self) -> bool:
        """Return whether the frame has a mask file that is black everywhere."""
        if self.mask is None:
            return False
        with errors_at(self.image, frame=self.number):
            return files.decode_image(self.mask, str(self.mask), "L").getbbox() is None

    def check(self) -> object:
        """Check the headers of image and mask. (`read` also finds damaged contents.)

        Returns:
            The EXIF orientation by which the image is to be turned; None: its pixels stay as they are stored.
        """
        height, width = self.lens.image_size
        with errors_at(require_file(self.image), frame=self.number):
            size = (height, width) if self.mask is None else files.stored_size(self.mask, str(self.mask))
            if not _same_aspect(size, (height, width)):
                raise BadImage(f"has {size[0]} x {size[1]} pixels, its image {height} x {width}", str(self.mask))
            with files.refused_as_bad(str(self.image)), files.open_image(self.image, files.FORMATS) as image:
                orientation = read_exif(image).get(ORIENTATION)
                as_stored = image.size == (width, height)
                sideways = orientation in SIDEWAYS
                as_upright = image.size == (height, width) if sideways else as_stored
                if not as_stored and not as_upright:
                    differs = f"has {image.height} x {image.width} pixels, its camera {height} x {width}"
                    raise ImageError(f"{differs}: give the photos that the cameras were computed for, of any size")
                if orientation not in TRANSPOSITIONS:
                    return None
                unclear = as_stored and (as_upright or self.orientation == "unknown") and self.orientation != "ignored"
                if unclear or image.format == "TIFF":  # decoding turns a TIFF
                    turned = f"is to be turned (EXIF orientation {orientation}), its camera's pose perhaps not"
                    raise ImageError(f"{turned}: save the pixels as the pose sees them, without that tag")
                return None if as_stored else orientation


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
    """Sort frames by file name, `r_2` before `r_10`, and refuse fewer than 6 frames, or an image that occurs twice."""
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"{len(frames)} frames; a capture needs at least {FEWEST_FRAMES}")
    numbers: dict[Path, int] = {}
    for frame in frames:
        first = numbers.setdefault(frame.image.resolve(), frame.number)
        if first != frame.number:
            raise BadAnnotation(f"the same image as frame {first}: {frame.image}", frame=frame.number)
    return tuple(sorted(frames, key=lambda frame: by_numbers(frame.image)))


def present_image(root: Path, name: str, listings: Listings) -> Path:
    """Return the path of an image below `root`, whose name may lack its suffix or have another case.

    Args:
        listings: folders that were listed already; it is added to.

    Returns:
        The path, also if there is no such image.

    Raises:
        OutsidePath: as in `path_below`.
    """
    name = name.replace("\\", "/")
    for suffix in ("", *SUFFIXES):
        # `path_below` resolves links, which takes long for many missing images.
        if isfile(root / (name + suffix)):
            return path_below(root, name + suffix)
    image = path_below(root, name)
    if image.parent not in listings:
        paths = sorted(image.parent.iterdir()) if image.parent.is_dir() else []
        listings[image.parent] = {_plain(path.name): path.name for path in paths}
    for suffix in ("", *SUFFIXES):
        other = listings[image.parent].get(_plain(image.name + suffix))
        if other is not None:
            return image.with_name(other)
    return image


def _plain(name: str) -> str:
    """Return a file name in small letters, with `.jpg` for JPEG's other suffixes."""
    stem, suffix = splitext(name.lower())
    return f"{stem}.jpg" if suffix in (".jpeg", ".jpe", ".jfif") else stem + suffix


def warn_of_missing(path: Path, missing: Sequence[str], frames: int) -> None:
    """Name the images that the file at `path` lists, in `frames` frames, and that are not there."""
    if missing:
        counted = f"{len(missing)} of {frames} frames have no image and are left out"
        logger.warning("%s: %s: %s", path, counted, first_names(missing))


def fit_lens(frame: CapturedFrame) -> CapturedFrame:
    """Return the frame with the lens of its image, if that is smaller or larger (3DGS's data set) or to be turned.

    An image that has another aspect, or that cannot be read, is refused by `CapturedFrame.check` and `read`.
    """
    with suppress(ImageError), files.open_image(frame.image, files.FORMATS) as image:
        for size in (image.size[::-1], image.size):
            if size == frame.lens.image_size:
                break
            if _same_aspect(size, frame.lens.image_size):
                return replace(frame, lens=frame.lens.resized(size))
            if read_exif(image).get(ORIENTATION) not in SIDEWAYS:
                break
    return frame


def _same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether one size is a multiple of the other, up to the rounding of a side."""
    down = size[0] / other[0]
    across = size[1] / other[1]
    return abs(down - across) <= max(1, down, across) / min(other)


def undistorted_lens(lens: Lens) -> Lens:
    """Return the pinhole lens of undistorted images, which are larger or smaller and show no unseen pixels.

    Raises:
        CompleteSplatError: the lens distorts, and pycolmap is missing.
        BadCamera: the distortion leaves no usable image.
    """
    if not any(lens.distortion):
        return lens
    pycolmap = import_pycolmap()
    height, width = lens.image_size
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), _distorted(lens))
    down = pinhole.height / height
    across = pinhole.width / width
    if down * across < SMALLEST_AREA or max(down, across) >= LARGEST_SIDE:
        raise BadCamera(f"distortion {lens.distortion} leaves no usable image")
    fx, fy, x, y = map(float, pinhole.params)
    return Lens(focal=(fx, fy), center=(x, y), image_size=(pinhole.height, pinhole.width))


def undistort(image: Image.Image, lens: Lens) -> Image.Image:
    """Return an undistorted image, or the image itself if its lens does not distort."""
    if not any(lens.distortion):
        return image
    pycolmap = import_pycolmap()
    options = pycolmap.UndistortCameraOptions()
    bitmap = pycolmap.Bitmap.from_array(np.array(image))
    return Image.fromarray(pycolmap.undistort_image(options, bitmap, _distorted(lens))[0].to_array())


def import_pycolmap() -> ModuleType:
    """Import pycolmap without its handler of SIGTERM, which ends a program before it has cleared up."""
    handler = signal.getsignal(signal.SIGTERM)
    with needing("colmap", "lenses with distortion and cameras=colmap need pycolmap"):
        import pycolmap
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def _distorted(lens: Lens) -> "Camera":
    height, width = lens.image_size
    coefficients = [*lens.distortion, *[0.0] * 8][:8]
    params = [*lens.focal, *lens.center, *coefficients]
    return import_pycolmap().Camera(model="FULL_OPENCV", width=width, height=height, params=params)
