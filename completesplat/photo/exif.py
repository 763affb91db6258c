"""Orientation and field of view from the EXIF record of a photo."""

import math
from collections.abc import Mapping
from contextlib import suppress
from numbers import Real

from PIL import ExifTags, Image

ORIENTATION = ExifTags.Base.Orientation
# Transposition that makes the stored image upright (EXIF 2.32, tag 0x0112; 1 is already upright).
TRANSPOSITIONS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
FULL_FRAME_WIDTH = 36.0  # mm
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # by FocalPlaneResolutionUnit; 4 and 5 are in common use


Tags = dict[int, object]


def read_exif(image: Image.Image) -> Tags:
    """Return all readable EXIF tags of an image that is decoded and still open.

    When Pillow decodes a TIFF, it turns it upright and removes the orientation from its record.
    """
    tags: Tags = {}
    with suppress(Exception):  # Pillow's parser raises almost any exception on a damaged record.
        exif = image.getexif()
        tags.update(exif)
        tags.update(exif.get_ifd(ExifTags.IFD.Exif))
    return tags


def photo_fov(exif: Mapping[int, object], size: tuple[int, int]) -> float | None:
    """Return the field of view in degrees across the longer side of a photo, or None if it is not recorded.

    The focal length in pixels is FocalLengthIn35mmFilm / 36 mm * longer side (the longer side of the image corresponds
    to the 36 mm of a full frame), else FocalLength * FocalPlaneXResolution, scaled from the recorded to the actual
    image size. Then fov = 2 atan(longer side / (2 focal)). The result is wrong for cropped or stitched images.
    """
    equivalent = _positive(exif.get(ExifTags.Base.FocalLengthIn35mmFilm))
    focal = equivalent / FULL_FRAME_WIDTH * max(size) if equivalent else _focal_from_sensor(exif, max(size))
    if focal is None:
        return None
    fov = math.degrees(2 * math.atan(max(size) / (2 * focal)))
    return fov if 1 < fov < 170 else None


def _focal_from_sensor(exif: Mapping[int, object], longer_side: int) -> float | None:
    """Return the focal length in pixels from the sensor's resolution, or None if it is not recorded."""
    focal = _positive(exif.get(ExifTags.Base.FocalLength))
    resolution = _positive(exif.get(ExifTags.Base.FocalPlaneXResolution))
    unit = exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)
    if focal is None or resolution is None or not isinstance(unit, int) or unit not in MILLIMETRES:
        return None
    width = _positive(exif.get(ExifTags.Base.ExifImageWidth))
    height = _positive(exif.get(ExifTags.Base.ExifImageHeight))
    scale = 1.0 if width is None or height is None else longer_side / max(width, height)
    return focal * resolution / MILLIMETRES[unit] * scale


def _positive(value: object) -> float | None:
    """Return a finite number above 0, or None for anything else (0 means "unknown", and 0/0 occurs)."""
    if not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
