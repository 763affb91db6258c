"""Pictures as the bytes that a prepared store holds, and back."""

import io
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.data.checks import BadPicture

# What Pillow is told for each codec. BMP is not compressed: more than twice the bytes of PNG, decoded in a ninth of the
# time.
CODECS: dict[str, dict[str, Any]] = {
    "png": {"format": "PNG"},
    "jpeg": {"format": "JPEG", "quality": 95, "subsampling": 0},
    "bmp": {"format": "BMP"},
}


def encode(picture: UInt8[Tensor, "channel size size"], codec: str) -> bytes:
    """A file of three channels (colour) or one (grey); PNG and BMP are without loss."""
    # Here and below NumPy reorders the channels: PyTorch would wake its threads, which costs more than the picture.
    channels_last = np.ascontiguousarray(picture.numpy().transpose(1, 2, 0))
    image = Image.fromarray(channels_last.squeeze(-1) if len(picture) == 1 else channels_last)
    content = io.BytesIO()
    image.save(content, **CODECS[codec])
    return content.getvalue()


def decode(content: bytes, channels: int, size: int) -> UInt8[Tensor, "channel size size"]:
    """The inverse of `encode`.

    Raises:
        BadPicture: damaged, or with other channels or another size than expected.
    """
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG", "BMP")) as image:
            # The header is looked at before the pixels are, so that no bytes make a huge picture.
            wrong = image.size != (size, size) or len(image.getbands()) != channels
            pixels = None if wrong else np.array(image)
    # The decoders of damaged files raise nearly anything: OSError, SyntaxError, struct.error, KeyError, ...
    except Exception as error:
        raise BadPicture(f"cannot be decoded: {error}") from error
    if pixels is None or pixels.dtype != np.uint8:
        raise BadPicture(f"is no picture of {size} x {size} pixels with {channels} channels of 8 bits")
    return torch.from_numpy(np.ascontiguousarray(pixels.reshape(size, size, channels).transpose(2, 0, 1)))
