"""Reader of captures as a COLMAP model (sparse reconstruction) with its images."""

import struct
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from completesplat.data.captures.capture import Capture, CapturedFrame, Lens, check_lens, in_order, make_cloud
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    MissingFile,
    UnreadableFile,
    at,
    finite_array,
    inside,
    require_file,
)
from completesplat.errors import CompleteSplatError

# Number of parameters by camera model id in binary files (colmap, `src/colmap/sensor/models.h`); others are refused.
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}


def read_colmap(model: Path, images: Path, masks: Path | None = None) -> Capture:
    """Read a binary or text model with its registered images.

    COLMAP's poses are world-to-camera with OpenCV's axes, and the centre of the first pixel is (0.5, 0.5)
    (colmap.github.io/format.html). Both are this package's conventions too. The file name of an image's mask is the
    image's name with `.png` appended or as its suffix; a mask is the foreground.

    Args:
        model: folder with `cameras`, `images` and `points3D`, `.bin` or `.txt`.
        images: folder of the images; their names in the model are relative to it.

    Raises:
        CompleteSplatError: pycolmap is not installed.
        DataError: something is missing, damaged or impossible; the error has the file and COLMAP's image number.
    """
    try:
        import pycolmap
    except ImportError:
        raise CompleteSplatError("COLMAP models need pycolmap: pip install completesplat[colmap]") from None
    for folder in (model, images, masks):
        if folder is not None and not folder.is_dir():
            raise MissingFile("no such folder", str(folder))
    _check_complete(model)
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
        numbers = list(reconstruction.reg_image_ids())
    except Exception as error:  # such as ValueError, IndexError and RuntimeError
        raise UnreadableFile(f"not a COLMAP model ({' '.join(str(error).split())})", str(model)) from None
    frames = []
    with at(model):
        for number in numbers:
            with at(frame=number):
                frames.append(_read_frame(reconstruction, number, images, masks))
        ordered = in_order(frames)
    points = list(reconstruction.points3D.values())
    positions, colors = [point.xyz for point in points], [point.color for point in points]
    return Capture(images.resolve().parent.name, model, ordered, make_cloud(positions, colors, model))


def _read_frame(reconstruction: Any, number: int, images: Path, masks: Path | None) -> CapturedFrame:
    image = reconstruction.images[number]
    try:
        name = image.name
    except UnicodeDecodeError:
        raise BadAnnotation("the name of its picture is not UTF-8") from None
    path = require_file(inside(images, name))
    mask = None if masks is None else _find_mask(masks, name)
    pose = np.eye(4)
    pose[:3] = finite_array(image.cam_from_world().matrix(), (3, 4), "the pose")
    return CapturedFrame(number, path, mask, _lens_of(reconstruction.cameras[image.camera_id]), pose)


def _find_mask(masks: Path, name: str) -> Path:
    appended, replaced = (inside(masks, file) for file in (f"{name}.png", str(Path(name).with_suffix(".png"))))
    # `Path.is_file` raises if a name is too long.
    if not (isfile(appended) or isfile(replaced)):
        raise MissingFile(f"no such file, nor {replaced.name}", str(appended))
    return appended if isfile(appended) else replaced


def _lens_of(camera: Any) -> Lens:
    """Convert a COLMAP camera, whose parameters have the order of colmap.github.io/cameras.html."""
    name, size = camera.model_name, (camera.height, camera.width)
    values = [float(value) for value in camera.params]
    match name, values:
        case "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL", [f, cx, cy, *radial]:
            k1, k2 = [*radial, 0.0, 0.0][:2]
            return check_lens(Lens((f, f), (cx, cy), size, (k1, k2, 0.0, 0.0, 0.0)))
        case "PINHOLE", [fx, fy, cx, cy]:
            return check_lens(Lens((fx, fy), (cx, cy), size))
        case "OPENCV", [fx, fy, cx, cy, k1, k2, p1, p2]:
            return check_lens(Lens((fx, fy), (cx, cy), size, (k1, k2, p1, p2, 0.0)))
    raise BadCamera(f"camera model {name} is not supported; undistort the pictures with COLMAP's image_undistorter")


def _check_complete(model: Path) -> None:
    """Check the length of binary files, because pycolmap reads wrong numbers, or forever, from truncated ones."""
    for name, skip in RECORDS.items():
        path = model / f"{name}.bin"
        if not path.is_file():
            continue
        content = path.read_bytes()
        try:
            (count,), offset = struct.unpack_from("<Q", content), 8
            for _ in range(count):
                offset = skip(content, offset)
        except (struct.error, ValueError, OverflowError):  # OverflowError: an offset that no file has
            offset = -1
        if offset != len(content):
            raise UnreadableFile("cut off, or not COLMAP's", str(path))


def _after_camera(content: bytes, offset: int) -> int:
    _, model, _, _ = struct.unpack_from("<IiQQ", content, offset)
    if model not in PARAMETERS:
        raise BadCamera(f"COLMAP's camera model number {model} is not supported; undistort with its image_undistorter")
    return offset + 24 + 8 * PARAMETERS[model]


def _after_image(content: bytes, offset: int) -> int:
    end_of_name = content.index(b"\0", offset + 64)  # after id, pose and camera
    return end_of_name + 9 + 24 * int(struct.unpack_from("<Q", content, end_of_name + 1)[0])


def _after_point(content: bytes, offset: int) -> int:
    return offset + 51 + 8 * int(struct.unpack_from("<Q", content, offset + 43)[0])  # after id, xyz, colour, error


def _after_rig(content: bytes, offset: int) -> int:
    (sensors,), offset = struct.unpack_from("<I", content, offset + 4), offset + 8  # after id
    for number in range(sensors):  # kind and id; all but the first sensor also have a flag, and a pose if it is set
        has_pose = bool(number) and struct.unpack_from("<B", content, offset + 8)[0]
        offset += 8 + bool(number) + (56 if has_pose else 0)
    return offset


def _after_frame(content: bytes, offset: int) -> int:
    return offset + 68 + 16 * int(struct.unpack_from("<I", content, offset + 64)[0])  # after ids, pose


RECORDS = {
    "cameras": _after_camera,
    "images": _after_image,
    "points3D": _after_point,
    "rigs": _after_rig,
    "frames": _after_frame,
}
"""Functions that skip one record of each binary file; the records follow their number."""
