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
from torch.nn import functional

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.photo import files
from completesplat.photo.background import without_background
from completesplat.photo.crop import (
    SMALLEST_SIDE,
    Window,
    central_window,
    continued,
    cropped,
    only_within,
    opaque_box,
    part_within,
    window_around_object,
    window_of,
    window_with_object,
)
from completesplat.photo.exif import ORIENTATION, Tags, photo_fov, read_exif
from completesplat.quantities import Crop
from completesplat.tensors import TensorDataclass

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
FOVS = (0.1, 179)  # degrees; float32 holds neither the focal lengths nor the depths of others
ALL = (0.0, 0.0, 1.0, 1.0)  # left, top, right and bottom of a square, in shares of its side
PALE = 0.65  # share of white over what is not the photo's, where people see it
DEEP_GREY_MODES = (*files.SIXTEEN_BIT_MODES, "I", "F")

ImageLike: TypeAlias = str | Path | Image.Image | np.ndarray | Tensor


@dataclass(frozen=True)
class Photograph(TensorDataclass):
    """A photo as a model sees it.

    Attributes:
        image: a square of it, in sRGB from 0 to 1.
        fov_degrees: field of view across a side of the square, if the optical axis meets the middle of the square.
        fov_source: where the field of view is from: the user, EXIF, or the model's training images.
        photo_size: width and height of the whole photo, upright, in pixels.
        square: the same square with the photo's own pixels (`square_at`): RGB in sRGB, or grey floats from 0 to 1.
        window: the square in the photo's pixels; it may extend beyond the photo.
        part: the photo's part of the square (left, top, right, bottom in shares of its side), around which its border
            is continued. `ALL` for a cut-out object, which lies on the background of the weights.
        axis: where the optical axis meets the square, from the left and from the top, in shares of its side.
        cut_out: opacity of the object in the square, if the rest is transparent or was removed.
        visible: 0 where the image is hidden and 1 elsewhere; None if nothing is hidden.
    """

    image: Float[Tensor, "3 size size"]
    fov_degrees: float
    fov_source: Literal["given", "exif", "default"]
    photo_size: tuple[int, int]
    square: Image.Image
    window: Window
    part: tuple[float, float, float, float] = ALL
    axis: tuple[float, float] = (0.5, 0.5)
    cut_out: Float[Tensor, "1 size size"] | None = None
    visible: Float[Tensor, "1 size size"] | None = None

    def square_at(self, size: int) -> Float[Tensor, "3 _ _"]:
        """Return the square at another size, made of the photo's own pixels."""
        return _resized(self.square, size)

    def own_at(self, size: int) -> Float[Tensor, "1 _ _"] | None:
        """Return 1 in the photo's part of the square, at a size, and 0 around it; None if it is all of the square."""
        if self.part == ALL:
            return None
        centers = (torch.arange(size) + 0.5) / size
        left, top, right, bottom = self.part
        rows = (centers > top) & (centers < bottom)
        columns = (centers > left) & (centers < right)
        return (rows[:, None] & columns).float()[None]

    def shown_at(self, size: int) -> Float[Tensor, "3 _ _"]:
        """Return the square for people, at a size: black where it is hidden, and pale around the photo."""
        image = self.square_at(size)
        if self.visible is not None:
            image = image * functional.interpolate(self.visible[None], (size, size), mode="nearest")[0]
        own = self.own_at(size)
        return image if own is None else image + PALE * (1 - own) * (1 - image)

    def middle_at(self, size: int) -> Float[Tensor, "3 _ _"]:
        """Return the largest square in the middle of the photo's part of the square, at a size."""
        left, top, right, bottom = (round(share * self.square.width) for share in self.part)
        extent = (right - left, bottom - top)
        return _resized(self.square.crop(central_window(extent, min(extent), left, top)), size)


@dataclass(frozen=True)
class Framing:
    """Framing of a model's training images, and of photos for it.

    Attributes:
        size: side of the square images, in pixels.
        fov_degrees: their field of view; 50 is close to that of a phone's camera.
        reads_exif: whether the field of view of a photo's EXIF record replaces `fov_degrees`, if it has one.
        background: grey value from 0 to 1 behind transparent and removed pixels, white by default.
        object_share: share of the square's side that the longer side of an object fills. The square is then cropped
            around a cut-out or transparent object. None: it does not depend on objects.
        whole_object: whether the square of a cut-out or transparent object is the central one, enlarged such that it
            holds the whole object.
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
    source: ImageLike,
    framing: Framing,
    fov_degrees: float | None = None,
    remove_background: bool = False,
    crop: Crop = "whole",
) -> Photograph:
    """Turn an image upright, crop a square or continue its border to one, and resize it (Lanczos, antialiased).

    Transparency is composited over the background. An animation yields its first frame. An embedded colour profile is
    converted to sRGB. Grey images of 16 bits are scaled to [0, 1]; grey images of floats must lie in [0, 1].

    Args:
        source: a JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF or PPM file, recognized by its content; a PIL image;
            an array [height, width, 3] or tensor [3, height, width] of bytes, or floats in [0, 1] (rounded to bytes).
        fov_degrees: field of view across the photo's longer side, if it is known; that of the square, if this is
            cropped around an object (`Framing.object_share`).
        remove_background: whether to cut the object out of the whole image first (`without_background`).
        crop: the part of the photo (`window_of`). A cut-out or transparent object is framed by the framing instead, and
            is sought within [x, y, size].

    Raises:
        ImageError: the file is missing or not a complete image of one of these formats, has more than 64 million pixels
            (checked before decoding) or less than 8 pixels on a side, or its pixel values are ambiguous.
        CompleteSplatError: the field of view is outside `FOVS`, or errors of `without_background` and `window_of`.
    """
    for fov in (fov_degrees, framing.fov_degrees):
        if fov is not None and not FOVS[0] <= fov <= FOVS[1]:
            raise CompleteSplatError(f"the field of view must lie between {FOVS[0]} and {FOVS[1]} degrees, not {fov}")
    try:
        stored, exif = _loaded(source)
        upright = files.turn_upright(stored, exif.get(ORIENTATION))
        if remove_background:
            upright = _cut_out(upright, framing.background)
        window = window_of(upright.size, crop)
        transparent = opaque_box(upright) is not None
        if transparent and not isinstance(crop, str):
            upright = only_within(upright, window)
        around = _object_window(upright, framing) if isinstance(crop, str) or framing.object_share else None
        window = window if around is None else around
        square = _square(upright, window, transparent, stored, framing.background)
    except ImageError as error:
        name = source if isinstance(source, (str, Path)) else "the image"
        raise ImageError(f"{name}: {error}") from error.__cause__
    side = window[2] - window[0]
    fov, fov_source = _field_of_view(fov_degrees, exif, stored.size, framing)
    axis = (0.5, 0.5)
    if fov_source != "default" and (around is None or framing.object_share is None):
        fov = _fov_of_share(fov, side / max(upright.size))
        axis = ((upright.width / 2 - window[0]) / side, (upright.height / 2 - window[1]) / side)
    return Photograph(
        image=_resized(square, framing.size),
        fov_degrees=fov,
        fov_source=fov_source,
        photo_size=upright.size,
        square=square,
        window=window,
        part=ALL if transparent else _shares(window, upright.size),
        axis=axis,
        cut_out=_opacity(upright, window, framing.size) if transparent else None,
    )


def read_whole(source: ImageLike, background: float) -> Image.Image:
    """Return a whole image, upright, in RGB or grey floats from 0 to 1. Arguments and errors are `read_square`'s."""
    try:
        stored, exif = _loaded(source)
        return _normalized(files.turn_upright(stored, exif.get(ORIENTATION)), stored, background)
    except ImageError as error:
        name = source if isinstance(source, (str, Path)) else "the image"
        raise ImageError(f"{name}: {error}") from error.__cause__


def _square(
    image: Image.Image, window: Window, transparent: bool, stored: Image.Image, background: float
) -> Image.Image:
    """Return a `_normalized` square of an image. Beyond it is background if it is `transparent`, else its border."""
    if transparent:
        return _normalized(cropped(image, window), stored, background)
    left, top, right, bottom = part_within(window, image.size)
    part = _normalized(image.crop((left, top, right, bottom)), stored, background)
    return continued(part, (window[0] - left, window[1] - top, window[2] - left, window[3] - top))


def _shares(window: Window, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return the part of a window that lies within an image of this size, in shares of the window's side."""
    side = window[2] - window[0]
    left, top, right, bottom = part_within(window, size)
    return (
        (left - window[0]) / side,
        (top - window[1]) / side,
        (right - window[0]) / side,
        (bottom - window[1]) / side,
    )


def _opacity(image: Image.Image, window: Window, size: int) -> Float[Tensor, "1 size size"]:
    """Return the opacity of a square of a transparent image."""
    alpha = cropped(image, window).convert("RGBA").getchannel("A")
    pixels = np.array(alpha.resize((size, size), Image.Resampling.BILINEAR), dtype=np.float32)
    return torch.from_numpy(pixels / 255)[None]


def _field_of_view(
    given: float | None, exif: Tags, size: tuple[int, int], framing: Framing
) -> tuple[float, Literal["given", "exif", "default"]]:
    """Return the field of view in degrees across the photo's longer side, or a square's default, and its source."""
    if given is not None:
        return float(given), "given"
    recorded = photo_fov(exif, size) if framing.reads_exif else None
    if recorded is not None:
        return recorded, "exif"
    return float(framing.fov_degrees), "default"


def _fov_of_share(fov_degrees: float, share: float) -> float:
    """Return the field of view across a share of the length that has this field of view."""
    return math.degrees(2 * math.atan(share * math.tan(math.radians(fov_degrees) / 2)))


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


def _normalized(square: Image.Image, stored: Image.Image, background: float) -> Image.Image:
    """Convert pixels to RGB in sRGB, or those of deep grey images to floats from 0 to 1.

    Args:
        stored: the opened file, because only it has TIFF tags.
    """
    if square.mode in DEEP_GREY_MODES:
        return Image.fromarray(files.deep_grey(square, getattr(stored, "tag_v2", {})))
    if square.mode not in files.EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {square.mode} is not supported")
    return _to_srgb(square, background)


def _resized(square: Image.Image, size: int) -> Float[Tensor, "3 _ _"]:
    """Resize a `_normalized` square (Lanczos, antialiased) and return it in [0, 1]."""
    pixels = np.array(square.resize((size, size), Image.Resampling.LANCZOS))
    if square.mode == "F":
        return torch.from_numpy(pixels.clip(0, 1)).expand(3, size, size).contiguous()
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float() / 255


def _to_srgb(image: Image.Image, background: float) -> Image.Image:
    """Convert an image from its embedded colour profile to RGB, over the background where it is transparent."""
    converted = files.in_srgb(image)
    return files.over_grey(converted, background) if converted.mode == "RGBA" else converted
