"""Squares that are cut out of images or laid around them: the whole image, its middle, a given part, or an object."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.errors import BadCamera, CompleteSplatError, ImageError
from completesplat.photo.files import EIGHT_BIT_MODES
from completesplat.quantities import Crop

SMALLEST_SIDE = 8  # pixels of a photo, or of its square
MOST_ASPECT = 3  # longer side over shorter side of a photo that is kept whole
LARGEST_PADDED = 6000  # pixels; larger squares are reduced before they are padded, because their size has no bound

Window: TypeAlias = tuple[int, int, int, int]
"""Left, top, right and bottom of a square of an image, in pixels; it may extend beyond the image."""


class Square(NamedTuple):
    """Square part of an image, in pixels with fractions."""

    left: float
    top: float
    side: float


def principal_square(center: tuple[float, float], image_size: tuple[int, int]) -> Square:
    """Return the largest square centred on the principal point (x, y) in an image of (height, width).

    This is Splatter Image's crop (`co3d_normalisation.py`, `get_max_box_side`). The point must lie inside the image.
    """
    x, y = center
    height, width = image_size
    half = min(x, y, width - x, height - y)
    if not half > 0:
        raise BadCamera(f"principal point ({x:g}, {y:g}) lies outside of the {width} x {height} image")
    return Square(x - half, y - half, 2 * half)


def cut_square(image: Image.Image, square: Square, size: int) -> UInt8[Tensor, "channel size size"]:
    """Resize a square part of an image to `size`, with a Lanczos filter for colour and bilinearly for grey (masks)."""
    box = (square.left, square.top, square.left + square.side, square.top + square.side)
    resampling = Image.Resampling.LANCZOS if image.mode == "RGB" else Image.Resampling.BILINEAR
    # Rounding may put a full-size box slightly outside of the image, which Pillow refuses.
    box = tuple(np.clip(box, 0, [image.width, image.height] * 2).tolist())
    pixels = np.asarray(image.resize((size, size), resampling, box=box))
    return torch.from_numpy(pixels.reshape(size, size, -1).transpose(2, 0, 1).copy())


def central_window(size: tuple[int, int], side: int, left: int = 0, top: int = 0) -> Window:
    """Return the square of this side in the middle of a box with the size (width, height)."""
    left = left + (size[0] - side) // 2
    top = top + (size[1] - side) // 2
    return left, top, left + side, top + side


def window_of(size: tuple[int, int], crop: Crop) -> Window:
    """Return the square that a choice of the crop means in a photo of this size (width, height).

    Args:
        crop: "whole": the square around the photo, or around its middle if one side is more than `MOST_ASPECT` times as
            long as the other. "center": the largest square in its middle. [x, y, size]: the square whose upper left
            corner lies at shares x of the width and y of the height, with a side of a share of the shorter side.

    Raises:
        CompleteSplatError: the given square does not lie within the photo.
    """
    shorter = min(size)
    if crop == "center":
        return central_window(size, shorter)
    if crop == "whole":
        return central_window(size, min(max(size), MOST_ASPECT * shorter))
    x, y, share = (float(value) for value in crop)
    side = share * shorter
    right = x * size[0] + side
    lower = y * size[1] + side
    if not (x >= 0 and y >= 0 and right < size[0] + 0.5 and lower < size[1] + 0.5 and side >= SMALLEST_SIDE):
        raise CompleteSplatError(
            f"crop={list(crop)}: give [x,y,size], in shares of width, height and shorter side, of a square within the"
            f" photo, of {SMALLEST_SIDE} pixels or more"
        )
    ends = min(round(right), size[0]), min(round(lower), size[1])
    return ends[0] - round(side), ends[1] - round(side), *ends


def square_within(size: tuple[int, int], square: Sequence[float]) -> tuple[float, float, float]:
    """Return the square [x, y, size] (`window_of`) nearest to a given one that lies within a photo of this size.

    Args:
        size: the photo's width and height in pixels, of which the shorter has at least `SMALLEST_SIDE`.
    """
    width, height = size
    shorter = min(size)
    x, y, share = square
    share = min(max(share, SMALLEST_SIDE / shorter), 1.0)
    x = min(max(x, 0.0), 1 - share * shorter / width)
    y = min(max(y, 0.0), 1 - share * shorter / height)
    return x, y, share


def part_within(window: Window, size: tuple[int, int]) -> Window:
    """Return the part of a window that lies within an image of the size (width, height)."""
    left, top, right, bottom = window
    return max(left, 0), max(top, 0), min(right, size[0]), min(bottom, size[1])


def window_with_object(image: Image.Image) -> Window | None:
    """Return the smallest square in the middle that holds the central one and the opaque part of an image.

    Returns:
        None if all pixels are opaque.

    Raises:
        ImageError: no pixel is opaque.
    """
    box = opaque_box(image)
    if box is None:
        return None
    left, top, right, bottom = box
    width, height = image.size
    reach = max(width - 2 * left, 2 * right - width, height - 2 * top, 2 * bottom - height)
    return central_window(image.size, max(reach, min(image.size)))


def window_around_object(image: Image.Image, share: float) -> Window | None:
    """Return the square around the opaque part of an image such that its longer side fills this share of the square.

    Returns:
        None if all pixels are opaque.

    Raises:
        ImageError: no pixel is opaque.
    """
    box = opaque_box(image)
    if box is None:
        return None
    left, top, right, bottom = box
    size = (right - left, bottom - top)
    return central_window(size, round(max(size) / share), left, top)


def opaque_box(image: Image.Image) -> Window | None:
    """Return left, top, right and bottom of what is not transparent, or None if all pixels are opaque."""
    if image.mode not in EIGHT_BIT_MODES or not image.has_transparency_data:
        return None
    alpha = image.convert("RGBA").getchannel("A")
    if alpha.getextrema()[0] == 255:
        return None
    box = alpha.getbbox()
    if box is None:
        raise ImageError("nothing but transparency")
    return box


def only_within(image: Image.Image, window: Window) -> Image.Image:
    """Return an image that is transparent outside of a window within it."""
    kept = Image.new("RGBA", image.size)
    kept.paste(image.convert("RGBA").crop(window), window[:2])
    kept.info["icc_profile"] = image.info.get("icc_profile")
    return kept


def cropped(image: Image.Image, window: Window) -> Image.Image:
    """Crop a square. What extends beyond the image is transparent. A large square is reduced before it is padded."""
    left, top, right, bottom = window
    side = right - left
    if left >= 0 and top >= 0 and right <= image.width and bottom <= image.height:
        return image.crop(window)
    factor = -(-side // LARGEST_PADDED)
    left = left // factor
    top = top // factor
    side = side // factor
    return image.convert("RGBA").reduce(factor).crop((left, top, left + side, top + side))


def continued(image: Image.Image, window: Window) -> Image.Image:
    """Crop a square of an image in RGB or grey, whose border goes on where the square extends beyond the image.

    A large square is reduced before it is padded.
    """
    part = part_within(window, image.size)
    if part == window:
        return image.crop(window)
    factor = -(-(window[2] - window[0]) // LARGEST_PADDED)
    side = (window[2] - window[0]) // factor
    pixels = np.asarray(image.crop(part).reduce(factor))[:side, :side]
    widths = [(0, 0)] * pixels.ndim
    for axis in (0, 1):
        before = min((part[1 - axis] - window[1 - axis]) // factor, side - pixels.shape[axis])
        widths[axis] = (before, side - before - pixels.shape[axis])
    return Image.fromarray(np.pad(pixels, widths, mode="edge"))
