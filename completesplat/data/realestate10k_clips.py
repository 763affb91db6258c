"""One clip of RealEstate10K (Zhou et al., SIGGRAPH 2018), whichever form it is stored in, and what is refused of it.

A camera is 18 numbers: fx fy cx cy (in units of the picture's width and height), k1 k2 (always 0), and the 3 x 4
row-major `world_to_camera` in OpenCV axes (stereo-magnification, `stereomag/datasets.py:226-258`).
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from completesplat.data.checks import (
    ROTATION_TOLERANCE,
    BadAnnotation,
    BadCamera,
    BadPicture,
    TooFewFrames,
    require_file,
)
from completesplat.data.images import MOST_PIXELS, check_pixels, damage_refused
from completesplat.data.transforms import Square
from completesplat.errors import ImageError
from completesplat.geometry.cameras import Cameras

CAMERA_NUMBERS = 18
FORMATS = ("JPEG", "PNG")


@dataclass(frozen=True)
class Clip:
    """The frames of a clip, in order.

    Attributes:
        source: the file that holds the cameras.
        timestamps: microseconds of the video.
        cameras: [view], float64, in pixels of the stored pictures and in the clip's own units of length.
        read: (frame, square, size) -> the square part of that frame's picture, resized to `size`.
    """

    key: str
    source: Path
    timestamps: tuple[int, ...]
    cameras: Cameras
    read: Callable[[int, Square, int], UInt8[Tensor, "3 size size"]]


def clip_cameras(rows: Float[Tensor, "view 18"], timestamps: Sequence[int], image_size: tuple[int, int]) -> Cameras:
    """Cameras [view] (float64) for pictures of (height, width), from rows as they are stored.

    Raises:
        TooFewFrames: fewer than two.
        BadAnnotation: timestamps that repeat, or numbers that are not finite.
        BadCamera: no positive focal length, lens distortion, or a pose that is no rotation and translation.
    """
    if len(rows) < 2:
        raise TooFewFrames(f"{len(rows)} frames, at least two are needed")
    count = Counter(timestamps)
    repeated = [f for f, time in enumerate(timestamps) if count[time] > 1]
    _refuse(repeated, BadAnnotation, "another frame has its timestamp")
    rows = rows.double()
    rotation = rows[:, 6:].unflatten(1, (3, 4))[:, :, :3]
    deviation = (rotation @ rotation.mT - torch.eye(3, dtype=rows.dtype)).abs().amax(dim=(1, 2))
    rigid = (deviation <= ROTATION_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    _refuse(_frames(~rows.isfinite().all(dim=1)), BadAnnotation, "camera with numbers that are not finite")
    _refuse(_frames((rows[:, :2] <= 0).any(dim=1)), BadCamera, "focal length is not positive")
    _refuse(_frames((rows[:, 4:6] != 0).any(dim=1)), BadCamera, "lens distortion is not supported")
    _refuse(_frames(~rigid), BadCamera, "pose is not a rotation and translation")
    height, width = image_size
    intrinsics, pose = (torch.eye(n, dtype=rows.dtype).repeat(len(rows), 1, 1) for n in (3, 4))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = rows[:, 0] * width, rows[:, 1] * height
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = rows[:, 2] * width, rows[:, 3] * height
    pose[:, :3] = rows[:, 6:].unflatten(1, (3, 4))
    return Cameras(pose, intrinsics, image_size)


def _frames(bad: Tensor) -> list[int]:
    return bad.nonzero().flatten().tolist()


def _refuse(frames: list[int], kind: type[BadAnnotation | BadCamera], reason: str) -> None:
    if frames:
        raise kind(reason, frame=frames[0])


def picture_size(source: Path | bytes, file: str) -> tuple[int, int]:
    """(height, width) of an image file, from its header.

    Args:
        source: the file, or its content.
        file: what refusals name.

    Raises:
        MissingFile: no such file.
        BadPicture: no JPEG or PNG image, or one of more than 50 million pixels.
    """
    opened = BytesIO(source) if isinstance(source, bytes) else require_file(source)
    try:
        with damage_refused(FORMATS, MOST_PIXELS), Image.open(opened, formats=FORMATS) as image:
            check_pixels(image, MOST_PIXELS)
            return image.height, image.width
    except ImageError as error:
        raise BadPicture(str(error), file) from None
