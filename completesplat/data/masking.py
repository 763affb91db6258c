"""What of a photograph a model may not see: a box, or the white of a mask."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from completesplat.data.photograph import read_photograph
from completesplat.errors import CompleteSplatError

LANCZOS_REACH = 3
"""Of Lanczos' filter, in pixels of the coarser picture."""


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
    rows, columns = (slice(math.floor(a * side), math.ceil(b * side)) for a, b in ((upper, lower), (left, right)))
    hidden[rows, columns] = True
    return visible(hidden, size)


def outside_of_mask(photograph: Path, mask: Path, size: int) -> Float[Tensor, "1 size size"]:
    """The same for a mask, a picture that is white where the photograph is hidden, cropped as it is.

    Raises:
        ImageError: not a readable picture.
        CompleteSplatError: it is white nowhere.
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
    return counts[last] > counts[first]
