"""The visible part of a photo, if a box or a mask hides the rest."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.photo.reading import Framing, ImageLike, Photograph, read_square

SAME_SHAPE = 0.02  # largest difference between the side ratios of a photo and its mask
LANCZOS_REACH = 3  # radius of the filter, in pixels of the coarser image


def visible_part(
    photograph: Photograph, mask: ImageLike | None, box: Sequence[float] | None
) -> Float[Tensor, "1 size size"] | None:
    """Return 0 where a mask or a box hides the photo, and 1 elsewhere, or None without both.

    Args:
        mask: an image that is white where the photo is hidden, and is cropped like the photo.
        box: left, upper, right and lower edge of the hidden part, as fractions (0 to 1) of the photo's central square.

    Raises:
        CompleteSplatError: both are given, one of them does not fit, or the photo was cropped around an object.
    """
    if mask is not None and box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if mask is None and box is None:
        return None
    if photograph.crop != "center":
        raise CompleteSplatError("mask= and box= are of a photo's central square, but its object is shown in another")
    if mask is not None:
        return outside_of_mask(photograph, mask)
    assert box is not None
    return outside_of_box(photograph, box)


def outside_of_box(photograph: Photograph, box: Sequence[float]) -> Float[Tensor, "1 size size"]:
    """Return 1 where a photo is visible, and 0 where a box hides it.

    Args:
        box: see `visible_part`.

    Raises:
        CompleteSplatError: the box is not four numbers, or not of positive size within the square.
    """
    if len(box) != 4:
        raise CompleteSplatError(f"box={list(box)}: give [x0,y0,x1,y1]")
    left, upper, right, lower = box
    if not (0 <= left < right <= 1 and 0 <= upper < lower <= 1):
        raise CompleteSplatError(f"box={list(box)}: needs 0 <= x0 < x1 <= 1 and 0 <= y0 < y1 <= 1")
    side = min(photograph.photo_size)
    rows = slice(math.floor(upper * side), math.ceil(lower * side))
    columns = slice(math.floor(left * side), math.ceil(right * side))
    hidden = np.zeros((side, side), dtype=bool)
    hidden[rows, columns] = True
    return _visible_pixels(hidden, photograph.image.shape[-1])


def outside_of_mask(photograph: Photograph, mask: ImageLike) -> Float[Tensor, "1 size size"]:
    """Return 1 where a photo is visible, and 0 where a mask hides it.

    Args:
        mask: see `visible_part`.

    Raises:
        ImageError: the mask cannot be read.
        CompleteSplatError: it hides nothing, or has another shape than the photo.
    """
    name = mask if isinstance(mask, str | Path) else "the mask"
    given = read_square(mask, Framing(min(photograph.photo_size), background=0.0))
    ratios = [max(size) / min(size) for size in (photograph.photo_size, given.photo_size)]
    if abs(ratios[0] / ratios[1] - 1) > SAME_SHAPE:
        width, height = given.photo_size
        raise CompleteSplatError(f"{name}: {width} x {height} pixels, another shape than the photo's")
    hidden = given.image.mean(0).numpy() > 0.5
    if not hidden.any():
        raise CompleteSplatError(f"{name}: hides nothing; a mask is white where the photograph is hidden")
    return _visible_pixels(hidden, photograph.image.shape[-1])


def _visible_pixels(hidden: Bool[np.ndarray, "side side"], size: int) -> Float[Tensor, "1 size size"]:
    """Return 1 for those of size x size pixels to which no hidden pixel contributes in resizing, else 0.

    Resizing blurs by three pixels of the result, so the hidden region grows by as much, and leaves no traces outside.
    """
    for _ in range(2):
        hidden = _touched(hidden, size).T
    if hidden.all():
        raise CompleteSplatError("the whole photo is hidden; a mask is white in the hidden part and black elsewhere")
    return torch.from_numpy(~hidden).float()[None]


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
    counts = np.concatenate([np.zeros((1, hidden.shape[1]), dtype=int), hidden.cumsum(axis=0)])
    return counts[last] > counts[first]
