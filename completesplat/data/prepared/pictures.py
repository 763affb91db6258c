"""Pictures as the bytes that a prepared store holds, and back."""

import io

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.data.checks import BadPicture

CODECS = ("png", "jpeg")
# Level 1 decodes as fast as level 6 and is written two to three times faster, for 5 % more bytes.
PNG_LEVEL = 1
JPEG_QUALITY = 95


def encode(picture: UInt8[Tensor, "channel size size"], codec: str) -> bytes:
    """A file of three channels (colour) or one (grey): PNG without loss, or JPEG of quality 95 without subsampling."""
    # Here and below NumPy reorders the channels: PyTorch would wake its threads, which costs more than the picture.
    channels_last = np.ascontiguousarray(picture.numpy().transpose(1, 2, 0))
    image = Image.fromarray(channels_last.squeeze(-1) if len(picture) == 1 else channels_last)
    content = io.BytesIO()
    if codec == "png":
        image.save(content, "PNG", compress_level=PNG_LEVEL)
    else:
        image.save(content, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return content.getvalue()


def decode(content: bytes, channels: int, size: int) -> UInt8[Tensor, "channel size size"]:
    """The inverse of `encode`.

    Raises:
        BadPicture: damaged, or with other channels or another size than expected.
    """
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
            # The header is looked at before the pixels are, so that no bytes make a huge picture.
            wrong = image.size != (size, size) or len(image.getbands()) != channels
            pixels = None if wrong else np.array(image)
    # The decoders of damaged files raise nearly anything: OSError, SyntaxError, struct.error, KeyError, ...
    except Exception as error:
        raise BadPicture(f"cannot be decoded: {error}") from error
    if pixels is None or pixels.dtype != np.uint8:
        raise BadPicture(f"is no picture of {size} x {size} pixels with {channels} channels of 8 bits")
    return torch.from_numpy(np.ascontiguousarray(pixels.reshape(size, size, channels).transpose(2, 0, 1)))
