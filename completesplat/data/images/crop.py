"""Crop around the principal point, and resizing."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.errors import BadCamera


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
