"""The visible part of a photo, if a box or a mask hides the rest."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.photo.crop import continued
from completesplat.photo.reading import ImageLike, Photograph, read_whole

SAME_SHAPE = 0.02  # largest difference between the side ratios of a photo and its mask
Visible = Float[Tensor, "batch 1 height width"]  # masks that are 0 where an image is hidden, and 1 elsewhere
LANCZOS_REACH = 3  # radius of the filter, in pixels of the coarser image


def both(first: Visible | None, second: Visible | None) -> Visible | None:
    """Return the product of two masks, of which None is 1 everywhere."""
    if first is None or second is None:
        return second if first is None else first
    return first * second


def visible_part(
    photograph: Photograph, mask: ImageLike | None, box: Sequence[float] | None
) -> Float[Tensor, "1 size size"] | None:
    """Return 0 where a mask or a box hides the photo, and 1 elsewhere, or None without both.

    Args:
        mask: an image of the whole photo that is white where it is hidden.
        box: left, upper, right and lower edge of the hidden part, in shares (0 to 1) of the whole photo.

    Raises:
        CompleteSplatError: both are given, or one of them does not fit.
    """
    if mask is not None and box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if mask is None and box is None:
        return None
    if mask is not None:
        return outside_of_mask(photograph, mask)
    assert box is not None
    return outside_of_box(photograph, box)


def outside_of_box(photograph: Photograph, box: Sequence[float]) -> Float[Tensor, "1 size size"]:
    """Return 1 where a photo is visible, and 0 where a box hides it.

    Args:
        box: see `visible_part`.

    Raises:
        CompleteSplatError: the box is not four numbers, or not of positive size within the photo.
    """
    if len(box) != 4:
        raise CompleteSplatError(f"box={list(box)}: give [x0,y0,x1,y1]")
    left, upper, right, lower = box
    if not (0 <= left < right <= 1 and 0 <= upper < lower <= 1):
        raise CompleteSplatError(f"box={list(box)}: needs 0 <= x0 < x1 <= 1 and 0 <= y0 < y1 <= 1")
    width, height = photograph.photo_size
    rows = slice(math.floor(upper * height), math.ceil(lower * height))
    columns = slice(math.floor(left * width), math.ceil(right * width))
    hidden = np.zeros((height, width), dtype=bool)
    hidden[rows, columns] = True
    return _visible_pixels(hidden, photograph)


def outside_of_mask(photograph: Photograph, mask: ImageLike) -> Float[Tensor, "1 size size"]:
    """Return 1 where a photo is visible, and 0 where a mask hides it.

    Args:
        mask: see `visible_part`.

    Raises:
        ImageError: the mask cannot be read.
        CompleteSplatError: it hides nothing, or has another shape than the photo.
    """
    name = mask if isinstance(mask, str | Path) else "the mask"
    given = read_whole(mask, background=0.0)
    ratios = [width / height for width, height in (photograph.photo_size, given.size)]
    if abs(ratios[0] / ratios[1] - 1) > SAME_SHAPE:
        width, height = given.size
        raise CompleteSplatError(f"{name}: {width} x {height} pixels, another shape than the photo's")
    pixels = np.asarray(given.resize(photograph.photo_size, Image.Resampling.LANCZOS))
    hidden = pixels > 0.5 if pixels.ndim == 2 else pixels.mean(-1) > 127.5
    if not hidden.any():
        raise CompleteSplatError(f"{name}: hides nothing; a mask is white where the photograph is hidden")
    return _visible_pixels(hidden, photograph)


def _visible_pixels(hidden: Bool[np.ndarray, "height width"], photograph: Photograph) -> Float[Tensor, "1 size size"]:
    """Return 1 for those pixels of a photo's image to which no hidden pixel contributes in resizing, else 0.

    Resizing blurs by three pixels of the result, so the hidden region grows by as much, and leaves no traces outside.
    A border that continues hidden pixels is hidden, too.
    """
    image = Image.fromarray(np.uint8(255) * hidden)
    within = np.asarray(continued(image, photograph.window)) > 0
    if not within.any():
        raise CompleteSplatError("mask= or box= hides nothing of what crop= takes of the photo")
    for _ in range(2):
        within = _touched(within, photograph.image.shape[-1]).T
    if within.all():
        raise CompleteSplatError("the whole photo is hidden; a mask is white in the hidden part and black elsewhere")
    return torch.from_numpy(~within).float()[None]


def _touched(hidden: Bool[np.ndarray, "side _"], size: int) -> Bool[np.ndarray, "size _"]:
    """Return which of `size` rows a hidden pixel of the columns contributes to in resizing."""
    side = len(hidden)
    if side == size:  # the image is not resized
        return hidden
    scale = side / size
    centers = (np.arange(size) + 0.5) * scale
    reach = LANCZOS_REACH * max(scale, 1)
    first = np.clip(np.floor(centers - reach), 0, side).astype(int)
    last = np.clip(np.ceil(centers + reach), 0, side).astype(int)
    counts = np.concatenate([np.zeros((1, hidden.shape[1]), dtype=np.int32), hidden.cumsum(axis=0, dtype=np.int32)])
    return counts[last] > counts[first]
