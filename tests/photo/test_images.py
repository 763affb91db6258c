import io
import struct
import warnings
import zlib
from collections.abc import Callable
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image, ImageCms, ImageFile
from support import exif_turned

from completesplat.errors import BadImage, DataError, MissingFile
from completesplat.photo.crop import Square, cut_square
from completesplat.photo.files import decode_image


def grey_rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, axis=-1)


RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
GREY = RGB[..., 0]
DEEP = np.random.default_rng(1).integers(0, 65536, (6, 8), dtype=np.uint16)
INKS = np.random.default_rng(2).integers(0, 256, (6, 8, 4), dtype=np.uint8) * np.array([1, 1, 1, 0], dtype=np.uint8)
SMOOTH = grey_rgb(np.add.outer(np.linspace(30, 120, 16), np.linspace(20, 90, 16)).astype(np.uint8))
LARGE = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def saved(pixels: np.ndarray | Image.Image, kind: str = "PNG", orientation: int | None = None, **options) -> bytes:
    buffer = io.BytesIO()
    if orientation is not None:
        options["exif"] = exif_turned(orientation).tobytes()
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()


def palette(pixels: np.ndarray) -> Image.Image:
    """An image of at most 48 colours as indices into a palette."""
    colors, index = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True)
    image = Image.fromarray(index.reshape(pixels.shape[:2]).astype(np.uint8), "P")
    image.putpalette(colors.astype(np.uint8).tobytes())
    return image


PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
EIGHT = np.rint(DEEP / 65535 * 255).astype(np.uint8)
BITS = GREY > 127
NEGATIVE = Image.fromarray(255 - SMOOTH)

# name: (file, mode, expected pixels, tolerance where it is lossy)
RIGHT: dict[str, tuple] = {
    "png_rgb": (saved(RGB), "RGB", RGB),
    "webp_lossless": (saved(RGB, "WEBP", lossless=True), "RGB", RGB),
    "tiff_deflate": (saved(RGB, "TIFF", compression="tiff_deflate"), "RGB", RGB),
    "bmp_rgb": (saved(RGB, "BMP"), "RGB", RGB),
    "png_grey_as_rgb": (saved(GREY), "RGB", grey_rgb(GREY)),
    "png_grey_as_mask": (saved(GREY), "L", GREY),
    "rgb_of_equal_channels_as_mask": (saved(grey_rgb(GREY)), "L", GREY),
    "one_bit_png": (saved(BITS), "L", np.uint8(255) * BITS),
    "sixteen_bit_png_as_mask": (saved(DEEP), "L", EIGHT),
    "sixteen_bit_big_endian_tiff": (
        saved(Image.frombytes("I;16B", (8, 6), DEEP.astype(">u2").tobytes()), "TIFF"), "L", EIGHT,
    ),
    "palette_of_greys_as_mask": (saved(palette(grey_rgb(GREY))), "L", GREY),
    "palette_with_opaque_transparency": (saved(palette(RGB), transparency=bytes([255] * 48)), "RGB", RGB),
    "opaque_rgba": (saved(Image.fromarray(RGB).convert("RGBA")), "RGB", RGB),
    # Without black, red is what cyan leaves of white, and so on.
    "cmyk_tiff": (saved(Image.fromarray(INKS, "CMYK"), "TIFF"), "RGB", 255 - INKS[..., :3]),
    "png_with_foreign_profile": (saved(RGB, icc_profile=PROFILE), "RGB", RGB),
    "broken_exif": (saved(RGB, exif=b"Exif\0\0MM\0*\xff\xff\xff\xff"), "RGB", RGB),
    "meaningless_orientation": (saved(RGB, orientation=99), "RGB", RGB),
    "trailing_bytes": (saved(RGB) + b"more", "RGB", RGB),
    "orientation": (saved(RGB, orientation=6), "RGB", np.rot90(RGB, -1)),  # the others: test_exif.py
    "sixteen_bit_orientation": (saved(DEEP, orientation=6), "L", np.rot90(EIGHT, -1)),
    "progressive_jpeg": (saved(SMOOTH, "JPEG", quality=95, progressive=True), "RGB", SMOOTH, 4),
    "cmyk_jpeg": (saved(Image.fromarray(SMOOTH).convert("CMYK"), "JPEG"), "RGB", SMOOTH, 4),
    "mpo_of_two": (saved(SMOOTH, "MPO", save_all=True, append_images=[NEGATIVE], quality=95), "RGB", SMOOTH, 4),
    "jpeg_orientation_8": (saved(SMOOTH, "JPEG", quality=95, orientation=8), "RGB", np.rot90(SMOOTH), 4),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_the_pixels_are_those_of_the_file(name, tmp_path):
    """From bytes and from a file whose name claims another format."""
    content, mode, expected, *tolerance = RIGHT[name]
    (tmp_path / "a.jpg").write_bytes(content)
    for source in (content, tmp_path / "a.jpg"):
        image = decode_image(source, name, mode, expected.shape[:2])
        assert image.mode == mode
        assert np.abs(np.asarray(image).astype(int) - expected).max() <= sum(tolerance)


@pytest.fixture
def ramp(tmp_path):
    """A 20 x 30 image (height x width) whose value is four times the column plus five times the row."""
    Image.fromarray((4 * np.arange(30) + 5 * np.arange(20)[:, None]).astype(np.uint8)).save(tmp_path / "ramp.png")
    return tmp_path / "ramp.png"


def test_a_whole_pixel_crop_without_resizing_is_a_slice(ramp, tmp_path):
    pixels = cut_square(decode_image(ramp, str(ramp), "L", (20, 30)), Square(7, 3, 10), 10)
    assert np.array_equal(pixels[0].numpy(), 4 * np.arange(7, 17) + 5 * np.arange(3, 13)[:, None])
    Image.fromarray(DEEP).save(tmp_path / "mask.png")
    square = cut_square(decode_image(tmp_path / "mask.png", "mask.png", "L", (6, 8)), Square(1, 0, 6), 6)
    assert np.array_equal(square[0].numpy(), EIGHT[:, 1:7])


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_a_subpixel_crop_of_a_linear_image_keeps_to_the_plane(ramp, mode):
    """Pixel centres of the crop lie at left + (i + 0.5) side / size of the file, whose centres lie at i + 0.5."""
    left, top, side, size = 6.3, 2.6, 15.0, 12
    pixels = cut_square(decode_image(ramp, str(ramp), mode, (20, 30)), Square(left, top, side), size).numpy()
    centers = (np.arange(size) + 0.5) * side / size - 0.5
    expected = 4 * (left + centers)[None, :] + 5 * (top + centers)[:, None]
    assert pixels.shape == (3 if mode == "RGB" else 1, size, size)
    inner = (slice(2, -2), slice(2, -2))
    # Less than half a pixel's rise along one axis; Pillow's discrete filters are not exact on a plane.
    assert np.abs(pixels[0][inner] - expected[inner]).max() < 1.6


def cut(content: bytes) -> bytes:
    return content[: int(len(content) * 0.6)]


def png(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """An RGB PNG by hand."""
    head = (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in (head, *chunks, (b"IEND", b""))
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def wrong_checksum() -> bytes:
    """Pixels replaced together with zlib's own checksum; only the chunk's tells."""
    rows = b"".join(b"\0" + row.tobytes() for row in LARGE)
    good, other = zlib.compress(rows, 0), zlib.compress(rows[:-1] + bytes([rows[-1] ^ 1]), 0)
    return png(32, 24, (b"IDAT", good)).replace(good, other)


LARGE_GREY = LARGE[..., 0]
# name: (file, mode, part of the message); they belong where 24 x 32 pixels are annotated.
BAD: dict[str, tuple[bytes, str, str]] = {
    "empty": (b"", "RGB", "the file is empty"),
    "html": (b"<html>\n<body>404</body>\n</html>", "RGB", "not an image"),
    "postscript": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "RGB", "not an image"),
    "gif": (saved(LARGE, "GIF"), "RGB", "not an image in one of the formats JPEG, PNG, WEBP, TIFF, BMP"),
    **{f"cut_{kind}": (cut(saved(LARGE, kind)), "RGB", "cannot be decoded") for kind in ("JPEG", "PNG", "WEBP")},
    "another_checksum": (wrong_checksum(), "RGB", "cannot be decoded"),
    "text_bomb": (
        png(1, 1, (b"zTXt", b"k\0\0" + zlib.compress(bytes(10**7))), (b"IDAT", zlib.compress(bytes(4)))),
        "RGB", "cannot be decoded",
    ),
    "bomb_of_65_megapixels": (png(8100, 8000, (b"IDAT", zlib.compress(bytes(99)))), "RGB", "make it smaller first"),
    "animated_png": (saved(LARGE, save_all=True, append_images=[Image.fromarray(255 - LARGE)]), "RGB", "2 frames"),
    "hardly_translucent": (saved(np.dstack([LARGE, 255 - np.eye(24, 32, dtype=np.uint8)])), "RGB", "transparent"),
    "transparent_colour": (saved(LARGE, transparency=tuple(LARGE[0, 0].tolist())), "RGB", "transparent"),
    "transparent_deep_grey": (
        saved(LARGE_GREY.astype(np.uint16) * 257, transparency=int(LARGE_GREY[0, 0]) * 257), "L", "transparent",
    ),
    "transparent_palette_entry": (saved(Image.fromarray(LARGE).quantize(16), transparency=0), "RGB", "transparent"),
    "coloured_mask": (saved(LARGE), "L", "has colours"),
    "float_tiff": (saved(LARGE_GREY.astype(np.float32) / 255, "TIFF"), "RGB", "colour mode F"),
    "other_size": (saved(LARGE[:23]), "RGB", "has 23 x 32 pixels when upright, its annotation says 24 x 32"),
    "annotated_before_rotation": (saved(LARGE, orientation=6), "RGB", "has 32 x 24 pixels when upright"),
}  # fmt: skip


def refuse(read: Callable[[], object], name: str, part: str, kind: type[DataError] = BadImage) -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(DataError) as caught:
            read()
    assert not warned
    assert type(caught.value) is kind
    assert (caught.value.file, caught.value.sequence, caught.value.frame) == (name, None, None)
    assert part in caught.value.reason
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", BAD)
def test_a_bad_image_is_refused_by_name(name, tmp_path, monkeypatch):
    content, mode, part = BAD[name]
    path = tmp_path / f"{name}.jpg"
    path.write_bytes(content)
    if "megapixels" in name:
        monkeypatch.setattr(ImageFile.ImageFile, "load", lambda self: pytest.fail("decoded"))
    refuse(lambda: decode_image(path, str(path), mode, (24, 32)), str(path), part)
    refuse(lambda: decode_image(content, "frame 7 of x", mode, (24, 32)), "frame 7 of x", part)


def test_places_without_a_usable_file_are_refused(tmp_path):
    (tmp_path / "ring.png").symlink_to("ring.png")
    for place in (tmp_path / "none.png", tmp_path, tmp_path / "ring.png", tmp_path / ("n" * 300)):
        refuse(lambda place=place: decode_image(place, str(place), "RGB"), str(place), "no such file", MissingFile)
    with (tmp_path / "sparse.png").open("wb") as file:
        file.truncate(10**12)
    refuse(lambda: decode_image(tmp_path / "sparse.png", "sparse", "RGB"), "sparse", "bytes")


@pytest.mark.parametrize("error", [MemoryError(), RecursionError("deep"), KeyError("x"), struct.error("short")])
def test_whatever_a_decoder_raises_is_a_data_error(monkeypatch, error):
    monkeypatch.setattr(ImageFile.ImageFile, "load", Mock(side_effect=error))
    refuse(lambda: decode_image(saved(RGB, "BMP"), "name", "RGB"), "name", "cannot be decoded")
    monkeypatch.undo()
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    refuse(lambda: decode_image(cut(saved(RGB)), "name", "RGB"), "name", "LOAD_TRUNCATED_IMAGES")


def test_a_mask_of_0_and_1_is_refused_because_it_would_be_empty(tmp_path):
    Image.new("L", (4, 4), 1).save(tmp_path / "mask.png")
    with pytest.raises(BadImage, match="a mask has values from 0 to 255, not 0 and 1"):
        decode_image(tmp_path / "mask.png", "mask.png", "L")
    assert decode_image(tmp_path / "mask.png", "mask.png", "RGB").getextrema() == ((1, 1),) * 3
