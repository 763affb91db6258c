"""Conversion of any photo to a model's square input image, with its field of view."""

import math
import os
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.photo import files
from completesplat.photo.background import without_background
from completesplat.photo.crop import Window, central_window, cropped, window_around_object, window_with_object
from completesplat.photo.exif import ORIENTATION, Tags, crop_fov, read_exif
from completesplat.tensors import TensorDataclass

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
SMALLEST_SIDE = 8
FOVS = (0.1, 179)  # degrees; float32 holds neither the focal lengths nor the depths of others
DEEP_GREY_MODES = (*files.SIXTEEN_BIT_MODES, "I", "F")

ImageLike: TypeAlias = str | Path | Image.Image | np.ndarray | Tensor


@dataclass(frozen=True)
class Photograph(TensorDataclass):
    """A photo as a model sees it.

    Attributes:
        image: a square of it, in sRGB from 0 to 1.
        fov_degrees: field of view across a side of the square.
        fov_source: where the field of view is from: the user, EXIF, or the model's training images.
        photo_size: width and height of the whole photo, upright, in pixels.
        crop: whether the square is the central one, or was chosen for an object.
        visible: 0 where the image is hidden and 1 elsewhere; None if nothing is hidden.
    """

    image: Float[Tensor, "3 size size"]
    fov_degrees: float
    fov_source: Literal["given", "exif", "default"]
    photo_size: tuple[int, int]
    crop: Literal["center", "object"] = "center"
    visible: Float[Tensor, "1 size size"] | None = None


@dataclass(frozen=True)
class Framing:
    """Framing of a model's training images, and of photos for it.

    Attributes:
        size: side of the square images, in pixels.
        fov_degrees: their field of view; 50 is close to that of a phone's camera.
        reads_exif: whether the field of view of a photo's EXIF record replaces `fov_degrees`, if it has one.
        background: grey value from 0 to 1 behind transparent and removed pixels, white by default.
        object_share: share of the square's side that the longer side of an object fills. The square is then cropped
            around a cut-out or transparent object. None: the central square is cropped.
        whole_object: whether the central square is enlarged such that it holds the whole cut-out or transparent object.
            A field of view that is given or EXIF's grows with it; `fov_degrees` is of any square.
        training: what the weights know about their training images (`TrainingImages`); None: nothing is to be compared.
    """

    size: int
    fov_degrees: float = 50.0
    reads_exif: bool = True
    background: float = 1.0
    object_share: float | None = None
    whole_object: bool = False
    training: Mapping[str, object] | None = None


def read_square(
    source: ImageLike, framing: Framing, fov_degrees: float | None = None, remove_background: bool = False
) -> Photograph:
    """Turn an image upright, crop a square and resize it (Lanczos, antialiased).

    Transparency is composited over the background. An animation yields its first frame. An embedded colour profile is
    converted to sRGB. Grey images of 16 bits are scaled to [0, 1]; grey images of floats must lie in [0, 1].

    Args:
        source: a JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF or PPM file, recognized by its content; a PIL image;
            an array [height, width, 3] or tensor [3, height, width] of bytes, or floats in [0, 1] (rounded to bytes).
        fov_degrees: field of view of the central square, if it is known; with `object_share` that of the crop.
        remove_background: whether to cut the object out of the whole image first (`without_background`).

    Raises:
        ImageError: the file is missing or not a complete image of one of these formats, has more than 64 million pixels
            (checked before decoding) or less than 8 pixels on a side, or its pixel values are ambiguous.
        CompleteSplatError: the field of view is outside `FOVS`, or errors of `without_background`.
    """
    for fov in (fov_degrees, framing.fov_degrees):
        if fov is not None and not FOVS[0] <= fov <= FOVS[1]:
            raise CompleteSplatError(f"the field of view must lie between {FOVS[0]} and {FOVS[1]} degrees, not {fov}")
    try:
        stored, exif = _loaded(source)
        upright = files.turn_upright(stored, exif.get(ORIENTATION))
        if remove_background:
            upright = _cut_out(upright, framing.background)
        central = central_window(upright.size, min(upright.size))
        window = _object_window(upright, framing) or central
        image = _to_tensor(cropped(upright, window), stored, framing.size, framing.background)
    except ImageError as error:
        name = source if isinstance(source, (str, Path)) else "the image"
        raise ImageError(f"{name}: {error}") from error.__cause__
    crop: Literal["center", "object"] = "center" if window == central else "object"
    fov, fov_source = _field_of_view(fov_degrees, exif, stored.size, framing)
    if crop == "object" and fov_source != "default" and framing.object_share is None:
        fov = _enlarged_fov(fov, (window[2] - window[0]) / min(upright.size))
    return Photograph(image, fov, fov_source, upright.size, crop)


def _field_of_view(
    given: float | None, exif: Tags, size: tuple[int, int], framing: Framing
) -> tuple[float, Literal["given", "exif", "default"]]:
    """Return the field of view in degrees of the central square, and where it is from."""
    if given is not None:
        return float(given), "given"
    recorded = crop_fov(exif, size) if framing.reads_exif else None
    if recorded is not None:
        return recorded, "exif"
    return float(framing.fov_degrees), "default"


def _enlarged_fov(fov_degrees: float, ratio: float) -> float:
    """Return the field of view of a square that is larger by this ratio."""
    return math.degrees(2 * math.atan(ratio * math.tan(math.radians(fov_degrees) / 2)))


def _object_window(image: Image.Image, framing: Framing) -> Window | None:
    if framing.object_share is not None:
        return window_around_object(image, framing.object_share)
    return window_with_object(image) if framing.whole_object else None


def _cut_out(image: Image.Image, background: float) -> Image.Image:
    if image.mode not in files.EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {image.mode} goes without background=remove")
    return without_background(_to_srgb(image, background))


def _loaded(source: ImageLike) -> tuple[Image.Image, Tags]:
    """Return an image with its pixels, as it is stored, and its EXIF tags."""
    if isinstance(source, np.ndarray | Tensor):
        source = _pixels(source)
    if isinstance(source, str | Path):
        _require_content(Path(source))
    elif not isinstance(source, Image.Image):
        raise ImageError(f"{type(source).__name__}: give a file name, a PIL image, an array or a tensor")
    formats = files.photo_formats(FORMATS)
    with nullcontext(source) if isinstance(source, Image.Image) else files.open_image(source, formats) as file:
        if min(file.size) < SMALLEST_SIDE:
            raise ImageError(f"{file.size} pixels; at least {SMALLEST_SIDE} on a side are needed")
        if not isinstance(source, Image.Image):
            files.check_sums(file, source)
        file.load()
        return file, read_exif(file)


def _require_content(path: Path) -> None:
    try:
        exists = path.is_file()
    except OSError as error:  # such as a name that is too long
        raise ImageError(str(error.strerror)) from error
    if not exists:
        raise ImageError("a folder; give a file" if path.is_dir() else "no such file")
    if not os.path.getsize(path):
        raise ImageError("the file is empty")


def _pixels(image: np.ndarray | Tensor) -> Image.Image:
    """Convert an array (channel last) or tensor (channel first) of bytes, or of floats, which are rounded to bytes."""
    channel = 0 if isinstance(image, Tensor) else -1
    if image.ndim != 3 or image.shape[channel] != 3:
        raise ImageError(f"{tuple(image.shape)} in shape; arrays are [height, width, 3], tensors [3, height, width]")
    if isinstance(image, Tensor):
        known = image.float() if image.is_floating_point() else image  # NumPy has no bfloat16
        values = known.movedim(0, -1).numpy(force=True)
    else:
        values = image
    if values.dtype == np.uint8:
        return Image.fromarray(values)
    if not np.issubdtype(values.dtype, np.floating):
        raise ImageError(f"values are {values.dtype}; bytes, or floats in [0, 1], have one meaning")
    if not ((values >= 0) & (values <= 1)).all():
        raise ImageError("values outside of [0, 1]")
    return Image.fromarray(np.rint(255 * values.astype(np.float32)).astype(np.uint8))


def _to_tensor(square: Image.Image, stored: Image.Image, size: int, background: float) -> Float[Tensor, "3 size size"]:
    """Convert pixels to sRGB in [0, 1].

    Args:
        stored: the opened file, because only it has TIFF tags.
    """
    if square.mode in DEEP_GREY_MODES:
        grey = Image.fromarray(files.deep_grey(square, getattr(stored, "tag_v2", {})))
        resized = np.asarray(grey.resize((size, size), Image.Resampling.LANCZOS))
        return torch.from_numpy(resized.clip(0, 1)).expand(3, size, size).contiguous()
    if square.mode not in files.EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {square.mode} is not supported")
    small = _to_srgb(square, background).resize((size, size), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous().float() / 255


def _to_srgb(image: Image.Image, background: float) -> Image.Image:
    """Convert an image from its embedded colour profile to RGB, over the background where it is transparent."""
    converted = files.in_srgb(image)
    return files.over_grey(converted, background) if converted.mode == "RGBA" else converted
