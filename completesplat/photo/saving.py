"""Writing of image files, and the font of their labels."""

import io
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageFont


def image_bytes(image: Image.Image, kind: str, **options: int | bytes) -> bytes:
    """Return the content of an image file in Pillow's format `kind`."""
    content = io.BytesIO()
    image.save(content, kind, **options)
    return content.getvalue()


def save_image(image: Image.Image, path: Path, **options: int | bytes) -> None:
    """Write an image in the format of its path's suffix.

    A full disk raises OSError, while Pillow alone would truncate a JPEG.
    """
    path.write_bytes(image_bytes(image, Image.registered_extensions()[path.suffix], **options))


def save_jpeg(image: Float[np.ndarray, "height width 3"], path: Path) -> None:
    """Write colours in [0, 1] as a JPEG of high quality."""
    save_image(Image.fromarray(to_uint8(image)), path, quality=95, subsampling=0)


def to_uint8(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Convert colours or shares in [0, 1] to bytes."""
    return np.round(255 * values.clip(0, 1)).astype(np.uint8)


def label_font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font of labels, of a size in pixels: DejaVu Sans, because Pillow's own font lacks accents."""
    # Importing matplotlib, which contains it, takes a second.
    font = distribution("matplotlib").locate_file("matplotlib/mpl-data/fonts/ttf/DejaVuSans.ttf")
    return ImageFont.truetype(str(font), size)
