"""Float images to the bytes of a picture file."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def to_bytes(images: Float[Tensor, "*batch 3 height width"]) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Images (sRGB, 0 to 1, clamped) to bytes with the channels last.

    Raises:
        ValueError: values that are not finite.
    """
    if not images.isfinite().all():
        raise ValueError("images hold values that are not finite")
    scaled = images.detach().clamp(0, 1).mul(255).round().to(torch.uint8)
    return scaled.movedim(-3, -1).cpu().numpy()


def enlarge(
    images: Float[Tensor, "*batch channel height width"], factor: int
) -> Float[Tensor, "*batch channel tall wide"]:
    """Repeat every pixel `factor` times in both directions: larger, with nothing invented between the pixels."""
    return images.repeat_interleave(factor, dim=-2).repeat_interleave(factor, dim=-1)
