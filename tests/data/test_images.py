"""Unusual but sound images give exactly the pixels that their files describe; so do depth maps."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms

from completesplat.data.pictures.crop import Square, read_square
from completesplat.data.pictures.exif import ORIENTATION
from completesplat.data.pictures.files import decode, read_depth

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
GREY = RGB[..., 0]
DEEP = np.random.default_rng(1).integers(0, 65536, (6, 8), dtype=np.uint16)
INKS = np.random.default_rng(2).integers(0, 256, (6, 8, 4), dtype=np.uint8)
SMOOTH = np.stack(np.meshgrid(np.linspace(20, 90, 16), np.linspace(30, 120, 16)), -1).sum(-1).astype(np.uint8)
# Without black, red is what cyan leaves of white, and so on.
COMPLEMENT = 255 - INKS[..., :3]
# The upright picture by EXIF 2.32's definition, which names the sides where the stored row 0 and column 0 belong.
UPRIGHT = {
    1: lambda p: p,
    2: lambda p: p[:, ::-1],
    3: lambda p: p[::-1, ::-1],
    4: lambda p: p[::-1],
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, -1),
    7: lambda p: p[::-1, ::-1].swapaxes(0, 1),
    8: lambda p: np.rot90(p),
}


def saved(pixels: np.ndarray | Image.Image, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()


def exif(orientation: int) -> bytes:
    record = Image.Exif()
    record[ORIENTATION] = orientation
    return record.tobytes()


def opaque(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels, np.full(pixels.shape[:2], 255, dtype=np.uint8)])


def palette(pixels: np.ndarray) -> Image.Image:
    """A picture of at most 48 colours as indices into a palette."""
    colors, index = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True)
    image = Image.fromarray(index.reshape(pixels.shape[:2]).astype(np.uint8), "P")
    image.putpalette(colors.astype(np.uint8).tobytes())
    return image


def cmyk_without_black() -> Image.Image:
    inks = INKS.copy()
    inks[..., 3] = 0
    return Image.fromarray(inks, "CMYK")


def grey_rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, axis=-1)


PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
EIGHT = np.rint(DEEP / 65535 * 255).astype(np.uint8)
BITS = GREY > 127

# name: (file, mode, expected pixels)
RIGHT: dict[str, tuple[Callable[[], bytes], str, np.ndarray]] = {
    "png_rgb": (lambda: saved(RGB, "PNG"), "RGB", RGB),
    "webp_lossless": (lambda: saved(RGB, "WEBP", lossless=True), "RGB", RGB),
    "tiff_rgb": (lambda: saved(RGB, "TIFF"), "RGB", RGB),
    "tiff_deflate": (lambda: saved(RGB, "TIFF", compression="tiff_deflate"), "RGB", RGB),
    "bmp_rgb": (lambda: saved(RGB, "BMP"), "RGB", RGB),
    "png_grey_as_rgb": (lambda: saved(GREY, "PNG"), "RGB", grey_rgb(GREY)),
    "png_grey_as_mask": (lambda: saved(GREY, "PNG"), "L", GREY),
    "rgb_of_equal_channels_as_mask": (lambda: saved(grey_rgb(GREY), "PNG"), "L", GREY),
    "one_bit_png": (lambda: saved(BITS, "PNG"), "L", np.uint8(255) * BITS),
    "one_bit_tiff": (lambda: saved(BITS, "TIFF", compression="group4"), "L", np.uint8(255) * BITS),
    "sixteen_bit_png_as_mask": (lambda: saved(DEEP, "PNG"), "L", EIGHT),
    "sixteen_bit_png_as_rgb": (lambda: saved(DEEP, "PNG"), "RGB", grey_rgb(EIGHT)),
    "sixteen_bit_tiff": (lambda: saved(DEEP, "TIFF"), "L", EIGHT),
    "sixteen_bit_big_endian_tiff": (
        lambda: saved(Image.frombytes("I;16B", (8, 6), DEEP.astype(">u2").tobytes()), "TIFF"), "L", EIGHT,
    ),
    "palette_png": (lambda: saved(palette(RGB), "PNG"), "RGB", RGB),
    "palette_of_greys_as_mask": (lambda: saved(palette(grey_rgb(GREY)), "PNG"), "L", GREY),
    "palette_with_opaque_transparency": (
        lambda: saved(palette(RGB), "PNG", transparency=bytes([255] * 48)), "RGB", RGB,
    ),
    "palette_bmp": (lambda: saved(palette(RGB), "BMP"), "RGB", RGB),
    "opaque_rgba": (lambda: saved(opaque(RGB), "PNG"), "RGB", RGB),
    "opaque_grey_with_alpha": (lambda: saved(Image.fromarray(opaque(GREY[..., None]), "LA"), "PNG"), "L", GREY),
    "cmyk_tiff": (lambda: saved(cmyk_without_black(), "TIFF"), "RGB", COMPLEMENT),
    "png_with_foreign_profile": (lambda: saved(RGB, "PNG", icc_profile=PROFILE), "RGB", RGB),
    "broken_exif": (lambda: saved(RGB, "PNG", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff"), "RGB", RGB),
    "meaningless_orientation": (lambda: saved(RGB, "PNG", exif=exif(99)), "RGB", RGB),
    "trailing_bytes": (lambda: saved(RGB, "PNG") + b"more", "RGB", RGB),
    **{f"png_orientation_{n}": (lambda n=n: saved(RGB, "PNG", exif=exif(n)), "RGB", UPRIGHT[n](RGB)) for n in UPRIGHT},
    **{f"tiff_orientation_{n}": (lambda n=n: saved(RGB, "TIFF", exif=exif(n)), "RGB", UPRIGHT[n](RGB)) for n in (3, 6)},
    "sixteen_bit_orientation_6": (lambda: saved(DEEP, "PNG", exif=exif(6)), "L", np.rot90(EIGHT, -1)),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_the_pixels_are_those_of_the_file(name, tmp_path):
    """From bytes and from a file whose name claims another format. Without `deep_grey` the eight-bit limit would make
    `sixteen_bit_*` white, without `upright` the `*_orientation_*` would lie on their side.
    """
    make, mode, expected = RIGHT[name]
    (tmp_path / "a.jpg").write_bytes(make())
    for source in (make(), tmp_path / "a.jpg"):
        image = decode(source, name, mode, expected.shape[:2])
        assert image.mode == mode
        assert np.array_equal(np.asarray(image), expected)


LOSSY: dict[str, tuple[Callable[[], bytes], np.ndarray]] = {
    "jpeg": (lambda: saved(grey_rgb(SMOOTH), "JPEG", quality=95), grey_rgb(SMOOTH)),
    "progressive_jpeg": (lambda: saved(grey_rgb(SMOOTH), "JPEG", quality=95, progressive=True), grey_rgb(SMOOTH)),
    "grey_jpeg": (lambda: saved(SMOOTH, "JPEG", quality=95), grey_rgb(SMOOTH)),
    "cmyk_jpeg": (lambda: saved(Image.fromarray(grey_rgb(SMOOTH)).convert("CMYK"), "JPEG"), grey_rgb(SMOOTH)),
    "ycbcr_tiff": (lambda: saved(Image.fromarray(grey_rgb(SMOOTH)).convert("YCbCr"), "TIFF"), grey_rgb(SMOOTH)),
    "mpo_of_two": (
        lambda: saved(
            Image.fromarray(SMOOTH), "MPO", save_all=True, append_images=[Image.fromarray(255 - SMOOTH)], quality=95,
        ),
        grey_rgb(SMOOTH),
    ),
    "jpeg_orientation_8": (lambda: saved(SMOOTH, "JPEG", quality=95, exif=exif(8)), np.rot90(grey_rgb(SMOOTH))),
}  # fmt: skip


@pytest.mark.parametrize("name", LOSSY)
def test_lossy_files_are_read_to_within_their_loss(name):
    make, expected = LOSSY[name]
    assert np.abs(np.asarray(decode(make(), name, "RGB")).astype(int) - expected).max() <= 4


def test_a_mask_of_sixteen_bits_reaches_the_square_in_scale(tmp_path):
    Image.fromarray(DEEP).save(tmp_path / "mask.png")
    square = read_square(tmp_path / "mask.png", (6, 8), Square(1, 0, 6), 6, "L")
    assert np.array_equal(square[0].numpy(), EIGHT[:, 1:7])


DEPTH = np.array([[0.0, 0.5, 1.25], [3.0, 65504.0, 2.0**-14]], dtype=np.float16)


def write_depth(path: Path, depth: np.ndarray) -> Path:
    Image.fromarray(depth.view(np.uint16)).save(path)
    return path


@pytest.mark.parametrize("scale", [1.0, 0.37, 250.0])
def test_a_depth_map_is_float16_times_the_scale(tmp_path, scale):
    depth = read_depth(write_depth(tmp_path / "d.png", DEPTH), scale)
    torch.testing.assert_close(depth, torch.from_numpy(DEPTH.astype(np.float32))[None] * scale, rtol=1e-7, atol=0)


def test_depths_that_are_not_finite_are_unknown(tmp_path):
    holes = DEPTH.copy()
    holes[0, 1], holes[1, 0] = np.inf, np.nan
    depth = read_depth(write_depth(tmp_path / "d.png", holes), 2.0)
    assert depth[0, 0, 1] == depth[0, 1, 0] == 0
    assert depth[0, 0, 2] == 2.5


def test_an_all_zero_depth_map_is_all_unknown(tmp_path):
    assert not read_depth(write_depth(tmp_path / "d.png", np.zeros((2, 3), np.float16)), 1.0).any()
