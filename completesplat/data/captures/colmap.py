"""Reader of captures as a COLMAP model (sparse reconstruction), binary or text, with its images."""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from completesplat.data.captures.captured_frames import (
    Capture,
    CapturedFrame,
    Lens,
    Listings,
    fit_lens,
    in_order,
    present_image,
    warn_of_missing,
)
from completesplat.data.validation import finite_array, path_below, read_text, require_file
from completesplat.errors import BadAnnotation, BadCamera, DataError, MissingFile, UnreadableFile, errors_at
from completesplat.geometry.rotations import quaternion_to_matrix

# Names and numbers of parameters by model id (colmap, `src/colmap/sensor/models.h`).
MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
READ = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
PARTS = ("cameras", "images", "points3D")

Row = Sequence[float | str]
T = TypeVar("T")


def read_colmap(model: Path, images: Path, masks: Path | None = None) -> Capture:
    """Read a binary or text model with its registered images.

    COLMAP's poses are world-to-camera with OpenCV's axes, and the centre of the first pixel is (0.5, 0.5)
    (colmap.github.io/format.html). Both are this package's conventions too. The file name of an image's mask is the
    image's name with `.png` appended or as its suffix; a mask is the foreground.

    Args:
        model: folder with `cameras`, `images` and `points3D`, `.bin` or `.txt`.
        images: folder of the images; their names in the model are relative to it.

    Images that are not there are left out.

    Raises:
        DataError: something else is missing, damaged or impossible; the error has the file and COLMAP's image number.
    """
    if not images.is_dir():
        raise MissingFile("no such folder", str(images))
    suffix, read = _form(model)
    files = tuple(require_file(model / f"{name}.{suffix}") for name in PARTS)
    lenses = dict(_parsed(_camera_of, read, files[0]))
    with errors_at(files[1]):
        posed = _parsed(partial(_frame_of, lenses=lenses, images=images, masks=masks, listings={}), read, files[1])
        missing = sorted(frame.image.relative_to(images).as_posix() for frame in posed if not isfile(frame.image))
        warn_of_missing(files[1], missing, len(posed))
        frames = in_order([fit_lens(frame) for frame in posed if isfile(frame.image)])
    points = np.array(_parsed(lambda row: [float(coordinate) for coordinate in row[1:4]], read, files[2]))
    return Capture(files, frames, points if len(points) else None)


def is_model(folder: Path) -> bool:
    """Return whether a folder holds a model."""
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def image_count(model: Path) -> int:
    """Return the number of images of a model, 0 if it cannot be read."""
    suffix, read = _form(model)
    with suppress(DataError):
        return len(_parsed(len, read, model / f"images.{suffix}"))
    return 0


def _form(model: Path) -> tuple[str, Callable[[Path], Iterator[Row]]]:
    """Return the suffix that most of the model's files have, and its reader."""

    def files(suffix: str) -> int:
        return sum((model / f"{name}.{suffix}").is_file() for name in PARTS)

    suffix = max(READERS, key=files)
    return suffix, READERS[suffix]


def _parsed(parse: Callable[[Row], T], read: Callable[[Path], Iterator[Row]], path: Path) -> list[T]:
    """Read and parse all rows of a file, or refuse a damaged one."""
    try:
        with errors_at(path):
            return [parse(row) for row in read(path)]
    except (struct.error, ValueError, IndexError, OverflowError):
        raise UnreadableFile("cut off, or not COLMAP's", str(path)) from None


def _camera_of(row: Row) -> tuple[int, Lens]:
    """Return a camera's number and lens. The parameters have the order of colmap.github.io/cameras.html."""
    number, kind, width, height, *rest = row
    size = (int(height), int(width))
    parameters = tuple(map(float, rest))
    match kind, parameters:
        case ["SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL", (f, cx, cy, *radial)]:
            k1, k2 = [*radial, 0.0, 0.0][:2]
            return int(number), Lens((f, f), (cx, cy), size, (k1, k2))
        case ["PINHOLE" | "OPENCV" | "FULL_OPENCV", (fx, fy, cx, cy, *distortion)]:
            return int(number), Lens((fx, fy), (cx, cy), size, tuple(distortion))
    advice = "undistort the images with COLMAP's image_undistorter"
    raise BadCamera(f"camera model {kind} is not supported (there are: {', '.join(READ)}); {advice}")


def _frame_of(
    row: Row, lenses: Mapping[int, Lens], images: Path, masks: Path | None, listings: Listings
) -> CapturedFrame:
    """Return an image with its camera. A row has number, pose (qw, qx, qy, qz, tx, ty, tz), camera and name."""
    number = int(row[0])
    camera = int(row[8])
    name = str(row[9])
    with errors_at(frame=number):
        if camera not in lenses:
            raise BadAnnotation(f"no camera {camera}")
        pose = finite_array([float(value) for value in row[1:8]], (7,), "the pose")
        if not pose[:4].any():
            raise BadCamera("the quaternion of the pose is zero")
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3] = quaternion_to_matrix(torch.from_numpy(pose[:4])).numpy()
        world_to_camera[:3, 3] = pose[4:]
        image = present_image(images, name, listings)
        mask = None if masks is None or not isfile(image) else _find_mask(masks, name)
        return CapturedFrame(number, image, mask, lenses[camera], world_to_camera, "ignored")


def _find_mask(masks: Path, name: str) -> Path:
    appended = path_below(masks, f"{name}.png")
    replaced = path_below(masks, str(Path(name).with_suffix(".png")))
    # `Path.is_file` raises if a name is too long.
    if not (isfile(appended) or isfile(replaced)):
        raise MissingFile(f"no such file, nor {replaced.name}", str(appended))
    return appended if isfile(appended) else replaced


def _text_rows(path: Path) -> Iterator[Row]:
    """Yield the entries of a text file. Those of images have a second line for their features, which may be empty."""
    lines = map(str.strip, read_text(path).split("\n"))
    of_images = path.stem == "images"
    for line in lines:
        while line and not line.startswith("#"):
            yield line.split(maxsplit=9 if of_images else -1)
            following = next(lines, "") if of_images else ""
            # Another line than one of features is that of the next image.
            line = "" if _are_features(following.split()) else following


def _are_features(words: Sequence[str]) -> bool:
    """Return whether the words of a line are triples of two coordinates and the whole number of a point."""
    return len(words) % 3 == 0 and all(word.lstrip("-").isdecimal() for word in words[2::3])


def _binary_rows(path: Path) -> Iterator[Row]:
    """Yield the entries of a binary file, without the features of images and points."""
    content = path.read_bytes()
    offset = 0

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal offset
        values = struct.unpack_from(f"<{layout}", content, offset)
        offset += struct.calcsize(f"<{layout}")
        return values

    for _ in range(take("Q")[0]):
        if path.stem == "cameras":
            number, model, width, height = take("IiQQ")
            if not 0 <= model < len(MODELS):
                raise BadCamera(f"camera model number {model} is not supported; there are: {', '.join(READ)}")
            kind, count = list(MODELS.items())[model]
            yield number, kind, width, height, *take(f"{count}d")
        elif path.stem == "images":
            numbers = take("I7dI")
            end = content.index(b"\0", offset)
            name = take(f"{end - offset}sx")[0].decode()
            yield *numbers, name
            take(f"{24 * take('Q')[0]}x")
        else:
            yield take("Q3d11x")  # the rest is colour and error
            take(f"{8 * take('Q')[0]}x")
    if offset != len(content):
        raise ValueError


READERS = {"bin": _binary_rows, "txt": _text_rows}
"""Readers of the files of a model, the preferred one first."""
