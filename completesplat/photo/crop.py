"""Squares that are cut out of images: around the principal point, in the middle, or around an object."""

from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.errors import BadCamera, ImageError
from completesplat.photo.files import EIGHT_BIT_MODES

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


def window_with_object(image: Image.Image) -> Window | None:
    """Return the smallest square in the middle that holds the central one and the opaque part of an image.

    Returns:
        None if all pixels are opaque.

    Raises:
        ImageError: no pixel is opaque.
    """
    box = _opaque_box(image)
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
    box = _opaque_box(image)
    if box is None:
        return None
    left, top, right, bottom = box
    size = (right - left, bottom - top)
    return central_window(size, round(max(size) / share), left, top)


def _opaque_box(image: Image.Image) -> Window | None:
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
