"""Image files that must not reach a batch: how each is made, and what is said of it."""

import io
import struct
import zlib
from collections.abc import Callable

import numpy as np
from PIL import Image

RGB = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
GREY = RGB[..., 0]


def saved(pixels: np.ndarray | Image.Image, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()


def cut(content: bytes, share: float = 0.6) -> bytes:
    return content[: int(len(content) * share)]


def animated(kind: str) -> bytes:
    return saved(RGB, kind, save_all=True, append_images=[Image.fromarray(255 - RGB)])


def png(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """An RGB PNG by hand."""
    head = (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in (head, *chunks, (b"IEND", b""))
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def bmp(width: int, height: int) -> bytes:
    """A header without pixels."""
    return struct.pack("<2sIHHI", b"BM", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, *[0] * 6)


def wrong_checksum() -> bytes:
    """Pixels replaced together with zlib's own checksum; only the chunk's tells."""
    rows = b"".join(b"\0" + row.tobytes() for row in RGB)
    good, other = zlib.compress(rows, 0), zlib.compress(rows[:-1] + bytes([rows[-1] ^ 1]), 0)
    content = png(32, 24, (b"IDAT", good))
    return content.replace(good, other)


def alpha(value: int, shape: str = "RGBA") -> Image.Image:
    image = Image.fromarray(RGB).convert(shape)
    layer = Image.new("L", image.size, 255)
    layer.putpixel((3, 4), value)
    image.putalpha(layer)
    return image


def keyed(pixels: np.ndarray) -> bytes:
    """PNG's transparency by colour: the first pixel's."""
    key = tuple(int(v) for v in pixels[0, 0]) if pixels.ndim == 3 else int(pixels[0, 0])
    return saved(pixels, "PNG", transparency=key)


def rotated(kind: str) -> bytes:
    record = Image.Exif()
    record[0x0112] = 6
    return saved(RGB, kind, exif=record.tobytes())


# name: (file, mode, part of the message); they belong where 24 x 32 pixels are annotated.
BAD_IMAGES: dict[str, tuple[Callable[[], bytes], str, str]] = {
    "empty": (lambda: b"", "RGB", "the file is empty"),
    "text": (lambda: b"not found", "RGB", "not an image"),
    "html": (lambda: b"<html>\n<body>404</body>\n</html>", "RGB", "not an image"),
    "zeros": (lambda: bytes(4000), "RGB", "not an image"),
    "numpy_file": (lambda: b"\x93NUMPY\x01\0" + bytes(100), "RGB", "not an image"),
    "postscript": (lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "RGB", "not an image"),
    "gif": (lambda: saved(RGB, "GIF"), "RGB", "not an image in one of the formats JPEG, PNG, WEBP, TIFF, BMP"),
    "ppm": (lambda: saved(RGB, "PPM"), "RGB", "not an image"),
    "jpeg_2000": (lambda: saved(RGB, "JPEG2000"), "RGB", "not an image"),
    "signature_only": (lambda: b"\x89PNG\r\n\x1a\n", "RGB", "not an image"),
    "cut_jpeg": (lambda: cut(saved(RGB, "JPEG")), "RGB", "cannot be decoded"),
    "cut_progressive_jpeg": (lambda: cut(saved(RGB, "JPEG", progressive=True)), "RGB", "cannot be decoded"),
    "cut_png": (lambda: cut(saved(RGB, "PNG")), "RGB", "cannot be decoded"),
    "cut_mask": (lambda: cut(saved(GREY, "PNG")), "L", "cannot be decoded"),
    "cut_webp": (lambda: cut(saved(RGB, "WEBP")), "RGB", "cannot be decoded"),
    "cut_tiff": (lambda: cut(saved(RGB, "TIFF")), "RGB", "cannot be decoded"),
    "cut_bmp": (lambda: cut(saved(RGB, "BMP")), "RGB", "cannot be decoded"),
    "png_without_pixels": (lambda: png(32, 24), "RGB", "cannot be decoded"),
    "png_of_another_checksum": (wrong_checksum, "RGB", "cannot be decoded"),
    "png_of_no_width": (lambda: png(0, 24, (b"IDAT", zlib.compress(b""))), "RGB", "not an image"),
    "text_bomb": (
        lambda: png(1, 1, (b"zTXt", b"k\0\0" + zlib.compress(bytes(10**7))), (b"IDAT", zlib.compress(bytes(4)))),
        "RGB", "cannot be decoded",
    ),
    "bomb_of_51_megapixels": (lambda: png(7200, 7100, (b"IDAT", zlib.compress(bytes(99)))), "RGB", "50,000,000 pixels"),
    "bomb_of_144_megapixels": (lambda: png(12000, 12000, (b"IDAT", b"")), "RGB", "50,000,000 pixels"),
    "bomb_of_400_megapixels": (lambda: png(20000, 20000, (b"IDAT", b"")), "RGB", "50,000,000 pixels"),
    "bmp_of_a_huge_header": (lambda: bmp(12000, 12000), "RGB", "50,000,000 pixels"),
    "animated_png": (lambda: animated("PNG"), "RGB", "2 frames"),
    "animated_webp": (lambda: animated("WEBP"), "RGB", "2 frames"),
    "tiff_of_two_pages": (lambda: animated("TIFF"), "RGB", "2 frames"),
    "one_transparent_pixel": (lambda: saved(alpha(0), "PNG"), "RGB", "transparent"),
    "one_translucent_pixel": (lambda: saved(alpha(254), "PNG"), "RGB", "transparent"),
    "translucent_webp": (lambda: saved(alpha(9), "WEBP", lossless=True), "RGB", "transparent"),
    "translucent_grey": (lambda: saved(alpha(9, "LA"), "PNG"), "L", "transparent"),
    "transparent_colour": (lambda: keyed(RGB), "RGB", "transparent"),
    "transparent_grey": (lambda: keyed(GREY), "L", "transparent"),
    "transparent_deep_grey": (lambda: keyed(GREY.astype(np.uint16) * 257), "L", "transparent"),
    "transparent_palette_entry": (
        lambda: saved(Image.fromarray(RGB).quantize(16), "PNG", transparency=0), "RGB", "transparent",
    ),
    "coloured_mask": (lambda: saved(RGB, "PNG"), "L", "has colours"),
    "mask_of_palette_colours": (lambda: saved(Image.fromarray(RGB).quantize(16), "PNG"), "L", "has colours"),
    "float_tiff": (lambda: saved(GREY.astype(np.float32) / 255, "TIFF"), "RGB", "colour mode F"),
    "integer_tiff": (lambda: saved(GREY.astype(np.int32), "TIFF"), "RGB", "colour mode I"),
    "lab_tiff": (lambda: saved(Image.fromarray(RGB).convert("LAB"), "TIFF"), "RGB", "colour mode LAB"),
    "other_size": (lambda: saved(RGB[:23], "PNG"), "RGB", "has 23 x 32 pixels, its annotation says 24 x 32"),
    "other_size_of_a_mask": (lambda: saved(GREY[:, :31], "PNG"), "L", "has 24 x 31 pixels"),
    "annotated_before_rotation_jpeg": (lambda: rotated("JPEG"), "RGB", "before it is turned as its EXIF orientation 6"),
    "annotated_before_rotation_png": (lambda: rotated("PNG"), "RGB", "before it is turned as its EXIF orientation 6"),
    "annotated_before_rotation_tiff": (lambda: rotated("TIFF"), "RGB", "has 32 x 24 pixels"),
}  # fmt: skip


def depth_png(values: np.ndarray) -> bytes:
    return saved(values.astype(np.float16).view(np.uint16), "PNG")


BAD_DEPTHS: dict[str, tuple[Callable[[], bytes], float, str]] = {
    "eight_bits": (lambda: saved(GREY, "PNG"), 1.0, "16 bits"),
    "colours": (lambda: saved(RGB, "PNG"), 1.0, "16 bits"),
    "sixteen_bit_tiff": (lambda: saved(GREY.astype(np.uint16), "TIFF"), 1.0, "formats PNG"),
    "cut": (lambda: cut(depth_png(np.random.default_rng(0).random((24, 32)))), 1.0, "cannot be decoded"),
    "text": (lambda: b"depth", 1.0, "not an image"),
    "negative": (lambda: depth_png(np.array([[1.0, -0.5]])), 1.0, "negative"),
    "nothing_finite": (lambda: depth_png(np.array([[np.nan, np.inf]])), 1.0, "no finite depth"),
    "integers": (lambda: saved(np.arange(1, 1000, dtype=np.uint16)[None], "PNG"), 1.0, "integers"),
    "bomb": (lambda: png(12000, 12000, (b"IDAT", b"")), 1.0, "50,000,000 pixels"),
    "zero_scale": (lambda: depth_png(np.ones((2, 2))), 0.0, "scale adjustment"),
    "negative_scale": (lambda: depth_png(np.ones((2, 2))), -1.0, "scale adjustment"),
    "nan_scale": (lambda: depth_png(np.ones((2, 2))), float("nan"), "scale adjustment"),
    "infinite_scale": (lambda: depth_png(np.ones((2, 2))), float("inf"), "scale adjustment"),
}
