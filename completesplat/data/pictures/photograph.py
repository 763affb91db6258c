"""Any photograph as the square image that a model takes, with its field of view, and what of it is hidden."""

import io
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image, ImageCms
from torch import Tensor

from completesplat.data.pictures.exif import ORIENTATION, crop_fov, read_exif
from completesplat.data.pictures.files import (
    EIGHT_BIT_MODES,
    SIXTEEN_BIT_MODES,
    deep_grey,
    opened,
    over_grey,
    upright,
)
from completesplat.errors import CompleteSplatError, ImageError
from completesplat.tensors import TensorDataclass

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
SMALLEST_SIDE = 8
DEEP_GREY_MODES = (*SIXTEEN_BIT_MODES, "I", "F")
LANCZOS_REACH = 3  # of the filter, in pixels of the coarser picture


@dataclass(frozen=True)
class Photograph(TensorDataclass):
    """A square image (sRGB, 0 to 1) with the field of view across one of its sides, and where that came from."""

    image: Float[Tensor, "3 size size"]
    fov_degrees: float
    fov_source: Literal["given", "exif", "default"]


def read_photograph(
    path: str | Path,
    size: int,
    fov_degrees: float | None = None,
    default_fov_degrees: float = 50.0,
    background: float = 1.0,
    object_share: float | None = None,
) -> Photograph:
    """Read an image file upright, cut the largest square from its centre and resize that (Lanczos, antialiased).

    Transparency is laid over the background; of an animation the first frame is taken; an embedded colour profile is
    converted to sRGB. Grey images of 16 bits are scaled to [0, 1], grey images of floats must lie in it.

    Args:
        path: a JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF or PPM file, known by its content.
        fov_degrees: field of view of the square crop, if it is known.
        default_fov_degrees: the same for files without usable EXIF focal length (50 is close to a phone's main camera).
        background: grey value from 0 to 1, white by default.
        object_share: of pictures that are transparent around an object, the square around that object is taken whose
            side the object fills by this share; None: the central square, as of all others.

    Raises:
        ImageError: no such file, not a complete image of one of these formats, more than 50 million pixels (checked
            before decoding), less than 8 pixels on a side, or pixel values without one plain meaning.
        CompleteSplatError: a field of view outside (0, 180) degrees.
    """
    for fov in (fov_degrees, default_fov_degrees):
        if fov is not None and not 0 < fov < 180:
            raise CompleteSplatError(f"the field of view must lie between 0 and 180 degrees, not {fov}")
    try:
        _check_file(Path(path))
        with opened(path, FORMATS) as picture:
            if min(picture.size) < SMALLEST_SIDE:
                raise ImageError(f"{picture.size} pixels; at least {SMALLEST_SIDE} on a side are needed")
            picture.load()
            exif = read_exif(picture)
        turned = upright(picture, exif.get(ORIENTATION))
        square = (None if object_share is None else _around_object(turned, object_share)) or _central(turned)
        image = _to_tensor(square, picture, size, background)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from error.__cause__
    if fov_degrees is not None:
        return Photograph(image, float(fov_degrees), "given")
    if (recorded := crop_fov(exif, picture.size)) is not None:
        return Photograph(image, recorded, "exif")
    return Photograph(image, float(default_fov_degrees), "default")


def _central(picture: Image.Image) -> Image.Image:
    side = min(picture.size)
    left, top = (picture.width - side) // 2, (picture.height - side) // 2
    return picture.crop((left, top, left + side, top + side))


def _around_object(picture: Image.Image, share: float) -> Image.Image | None:
    """The square around what is not transparent, which may reach beyond the picture; None: all of it is opaque."""
    if not picture.has_transparency_data:
        return None
    cut_out = picture.convert("RGBA")
    alpha = cut_out.getchannel("A")
    if alpha.getextrema()[0] == 255:
        return None
    box = alpha.getbbox()
    if box is None:
        raise ImageError("nothing but transparency")
    left, top, right, bottom = box
    side = round(max(right - left, bottom - top) / share)
    left, top = (left + right - side) // 2, (top + bottom - side) // 2
    return cut_out.crop((left, top, left + side, top + side))


def _check_file(path: Path) -> None:
    try:
        found = path.is_file()
    except OSError as error:  # a name that is too long, say
        raise ImageError(str(error.strerror)) from error
    if not found:
        raise ImageError("no such file")
    if path.stat().st_size == 0:
        raise ImageError("the file is empty")


def _to_tensor(square: Image.Image, source: Image.Image, size: int, background: float) -> Float[Tensor, "3 size size"]:
    """Pixels as sRGB in [0, 1]; `source` is the opened file, which alone knows its TIFF tags."""
    if square.mode in DEEP_GREY_MODES:
        grey = Image.fromarray(deep_grey(square, getattr(source, "tag_v2", {})))
        resized = np.asarray(grey.resize((size, size), Image.Resampling.LANCZOS))
        return torch.from_numpy(resized.clip(0, 1)).expand(3, size, size).contiguous()
    if square.mode not in EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {square.mode} is not supported")
    small = _to_srgb(square, background).resize((size, size), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous().float() / 255


def _to_srgb(square: Image.Image, background: float) -> Image.Image:
    """An RGB image, transparency laid over the background, converted from its own colour profile where it has one."""
    profile = square.info.get("icc_profile")
    if square.has_transparency_data:
        square = over_grey(square, background)
    if profile:
        # A damaged profile, or one of another colour model than the pixels, is ignored, as viewers do.
        with suppress(ImageCms.PyCMSError, OSError):
            embedded = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            native = square if square.mode in ("L", "RGB", "CMYK") else square.convert("RGB")
            converted = ImageCms.profileToProfile(native, embedded, ImageCms.createProfile("sRGB"), outputMode="RGB")
            return converted if converted is not None else native
    return square.convert("RGB")


def outside_of_box(photograph: Path, box: Sequence[float], size: int) -> Float[Tensor, "1 size size"]:
    """1 where a photograph's square is visible, 0 where a box hides it; see `visible`.

    Args:
        box: left, upper, right and lower edge, in shares (0 to 1) of the photograph's central square.

    Raises:
        CompleteSplatError: not four numbers, or no box of positive size within the square.
    """
    if len(box) != 4:
        raise CompleteSplatError(f"box={list(box)}: give [x0,y0,x1,y1]")
    left, upper, right, lower = box
    if not (0 <= left < right <= 1 and 0 <= upper < lower <= 1):
        raise CompleteSplatError(f"box={list(box)}: needs 0 <= x0 < x1 <= 1 and 0 <= y0 < y1 <= 1")
    side = square_side(photograph)
    hidden = np.zeros((side, side), dtype=bool)
    hidden[math.floor(upper * side) : math.ceil(lower * side), math.floor(left * side) : math.ceil(right * side)] = True
    return visible(hidden, size)


def outside_of_mask(photograph: Path, mask: Path, size: int) -> Float[Tensor, "1 size size"]:
    """The same for a mask, a picture that is white where the photograph is hidden, cropped as it is.

    `ImageError` if it is not a readable picture, `CompleteSplatError` if it is white nowhere.
    """
    hidden = read_photograph(mask, square_side(photograph)).image.mean(0).numpy() > 0.5
    if not hidden.any():
        raise CompleteSplatError(f"{mask}: hides nothing; a mask is white where the photograph is hidden")
    return visible(hidden, size)


def square_side(photograph: Path) -> int:
    """Side in pixels of the largest square of a readable picture."""
    with Image.open(photograph) as picture:
        return min(picture.size)


def visible(hidden: Bool[np.ndarray, "side side"], size: int) -> Float[Tensor, "1 size size"]:
    """1 in those of size x size pixels to which no hidden pixel contributes when the picture is resized, else 0.

    Resizing blurs: what is hidden grows by three pixels of the result, so that nothing of it is left at its border.
    """
    for _ in range(2):
        hidden = _touched(hidden, size).T
    return torch.from_numpy(~hidden).float()[None]


def _touched(hidden: Bool[np.ndarray, "side _"], size: int) -> Bool[np.ndarray, "size _"]:
    side = len(hidden)
    if side == size:  # the picture is not resized
        return hidden
    scale = side / size
    centers = (np.arange(size) + 0.5) * scale
    reach = LANCZOS_REACH * max(scale, 1)
    first = np.clip(np.floor(centers - reach), 0, side).astype(int)
    last = np.clip(np.ceil(centers + reach), 0, side).astype(int)
    counts = np.concatenate([np.zeros((1, hidden.shape[1]), dtype=int), hidden.cumsum(axis=0)])
    touched: np.ndarray = counts[last] > counts[first]
    return touched
