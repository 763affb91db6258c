import struct
import warnings
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms, ImageFile

from completesplat.data.pictures.photograph import read_photograph
from completesplat.errors import ImageError

SIZE = 16


def picture(seed=0):
    """Random bytes, 16 x 16: read with size 16 nothing is resampled, so every pixel can be compared."""
    return np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)


def read_back(tmp_path, image, name="a.png", size=SIZE, **options):
    image.save(tmp_path / name, **options)
    return pixels(tmp_path / name, size)


def pixels(path, size=SIZE):
    image = read_photograph(path, size).image
    assert image.dtype == torch.float32
    assert 0 <= image.min() <= image.max() <= 1
    return image.permute(1, 2, 0).numpy()


def png(bits, color_type, samples, chunks=()):
    """A PNG file written by hand, for the depths that Pillow does not write."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = samples.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in samples)
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + head
        + b"".join(chunk(*c) for c in chunks)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_rgb_and_ycbcr(tmp_path):
    rgb = picture()
    assert np.array_equal(read_back(tmp_path, Image.fromarray(rgb)), np.float32(rgb) / 255)
    smooth = Image.fromarray(rgb).resize((4, 4)).resize((SIZE, SIZE), Image.Resampling.BICUBIC)
    got = read_back(tmp_path, smooth.convert("YCbCr"), "a.tif")
    assert np.abs(got - np.float32(smooth) / 255).max() < 4 / 255


def test_one_bit_and_grey(tmp_path):
    grey = picture()[..., 0]
    got = read_back(tmp_path, Image.fromarray(grey))
    assert np.array_equal(got, np.float32(grey)[..., None].repeat(3, -1) / 255)
    got = read_back(tmp_path, Image.fromarray(grey > 127))
    assert np.array_equal(got, np.float32(grey > 127)[..., None].repeat(3, -1))


def test_alpha_lies_over_white(tmp_path):
    rgb, alpha = picture(), picture(1)[..., :1]
    share = alpha / 255
    rgba = Image.fromarray(np.concatenate([rgb, alpha], -1))
    assert np.abs(read_back(tmp_path, rgba) - (rgb / 255 * share + 1 - share)).max() < 1 / 255
    la = Image.fromarray(np.concatenate([rgb[..., :1], alpha], -1), "LA")
    assert np.abs(read_back(tmp_path, la) - (rgb[..., :1] / 255 * share + 1 - share)).max() < 1 / 255


def test_palettes_and_their_transparent_color(tmp_path):
    index = np.arange(SIZE * SIZE, dtype=np.uint8).reshape(SIZE, SIZE)
    palette = picture(2).reshape(256, 3)
    image = Image.fromarray(index, "P")
    image.putpalette(palette.tobytes())
    expected = np.float32(palette[index]) / 255
    assert np.array_equal(read_back(tmp_path, image), expected)
    assert np.array_equal(read_back(tmp_path, image, "a.gif"), expected)
    expected[index == 7] = 1
    assert np.array_equal(read_back(tmp_path, image, transparency=7), expected)


def test_a_transparent_color_of_rgb_and_of_grey(tmp_path):
    rgb = picture()
    expected = np.float32(rgb) / 255
    expected[3, 5] = 1
    color = tuple(int(c) for c in rgb[3, 5])
    assert np.array_equal(read_back(tmp_path, Image.fromarray(rgb), transparency=color), expected)
    deep = (np.arange(SIZE * SIZE) * 256).astype(">u2").reshape(SIZE, SIZE)
    (tmp_path / "g.png").write_bytes(png(16, 0, deep, [(b"tRNS", struct.pack(">H", int(deep[3, 5])))]))
    expected = deep / 65535
    expected[3, 5] = 1
    np.testing.assert_allclose(pixels(tmp_path / "g.png"), expected[..., None].repeat(3, -1), atol=1e-6)


def test_cmyk(tmp_path):
    cmyk = np.concatenate([picture(), picture(1)[..., :1] // 2], -1)
    c, k = cmyk[..., :3] / 255, cmyk[..., 3:] / 255
    expected = (1 - c) * (1 - k)
    assert np.abs(read_back(tmp_path, Image.fromarray(cmyk, "CMYK"), "a.tif") - expected).max() < 1.5 / 255
    flat = np.broadcast_to(np.array([40, 200, 90, 30], np.uint8), (SIZE, SIZE, 4))
    got = read_back(tmp_path, Image.fromarray(np.ascontiguousarray(flat), "CMYK"), "a.jpg", quality=100)
    assert np.abs(got - np.array([215, 55, 165]) / 255 * 225 / 255).max() < 4 / 255


DEEP = np.linspace(0, 65535, SIZE * SIZE).reshape(SIZE, SIZE)


@pytest.mark.parametrize(("name", "kind"), [("a.png", "<u2"), ("a.tif", "<u2"), ("a.tif", ">u2"), ("a.tif", "<i4")])
def test_sixteen_bit_grey_is_scaled_not_clipped(tmp_path, name, kind):
    got = read_back(tmp_path, Image.fromarray(DEEP.astype(kind)), name)
    np.testing.assert_allclose(got, (DEEP.astype(np.uint16) / 65535)[..., None].repeat(3, -1), atol=1e-6)


@pytest.mark.parametrize(("color_type", "channels"), [(2, 3), (6, 4), (4, 2)])
def test_sixteen_bit_color_png(tmp_path, color_type, channels):
    deep = np.random.default_rng(0).integers(0, 65536, (SIZE, SIZE, channels)).astype(">u2")
    (tmp_path / "a.png").write_bytes(png(16, color_type, deep))
    color = deep[..., : 3 if channels > 2 else 1] / 65535
    alpha = deep[..., -1:] / 65535 if channels in (2, 4) else 1.0
    assert np.abs(pixels(tmp_path / "a.png") - (color * alpha + 1 - alpha)).max() < 2 / 255


@pytest.mark.parametrize("maxval", [4095, 65535])
def test_sixteen_bit_pgm(tmp_path, maxval):
    values = np.linspace(0, maxval, SIZE * SIZE).astype(">u2").reshape(SIZE, SIZE)
    (tmp_path / "a.pgm").write_bytes(f"P5 {SIZE} {SIZE} {maxval}\n".encode() + values.tobytes())
    np.testing.assert_allclose(pixels(tmp_path / "a.pgm")[..., 0], values / maxval, atol=1e-4)


def grey_tiff(values, bits, photometric=1):
    """A grey little-endian TIFF of one strip, written by hand."""
    data = values.tobytes()
    tags = [(256, 3, SIZE), (257, 3, SIZE), (258, 3, bits), (259, 3, 1), (262, 3, photometric), (273, 4, 8)]
    tags += [(277, 3, 1), (278, 3, SIZE), (279, 4, len(data))]
    directory = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", len(tags)) + directory + bytes(4)


def test_tiff_whose_zero_is_white(tmp_path):
    (tmp_path / "a.tif").write_bytes(grey_tiff(DEEP.astype("<u2"), 16, photometric=0))
    np.testing.assert_allclose(pixels(tmp_path / "a.tif")[..., 0], 1 - DEEP.astype("<u2") / 65535, atol=1e-6)


def test_tiff_of_twelve_bits(tmp_path):
    values = np.linspace(0, 4095, SIZE * SIZE).astype(np.uint16)
    first, second = values[::2], values[1::2]
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], -1).astype(np.uint8)
    (tmp_path / "a.tif").write_bytes(grey_tiff(packed, 12))
    np.testing.assert_allclose(pixels(tmp_path / "a.tif")[..., 0].ravel(), values / 4095, atol=1e-6)


def test_float_grey(tmp_path):
    values = np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32)
    np.testing.assert_allclose(read_back(tmp_path, Image.fromarray(values), "a.tif")[..., 0], values, atol=1e-6)


@pytest.mark.parametrize("value", [float("nan"), -0.5, 255.0, -1, 70_000])
def test_numbers_without_a_plain_meaning_are_refused(tmp_path, value):
    values = np.full((SIZE, SIZE), 0, np.float32 if isinstance(value, float) else np.int32)
    values[4, 4] = value
    with pytest.raises(ImageError, match="outside the range from black to white, or not finite"):
        read_back(tmp_path, Image.fromarray(values), "a.tif")
    with pytest.raises(ImageError, match="LAB is not supported"):
        read_back(tmp_path, Image.new("LAB", (SIZE, SIZE)), "b.tif")


@pytest.mark.parametrize("name", ["a.gif", "a.png", "a.webp", "a.mpo"])
def test_the_first_frame_of_an_animation(tmp_path, name):
    frames = [Image.new("RGB", (SIZE, SIZE), color) for color in ("red", "lime", "blue")]
    got = read_back(tmp_path, frames[0], name, save_all=True, append_images=frames[1:])
    assert np.abs(got - np.array([1.0, 0, 0])).max() < 3 / 255


def test_an_embedded_profile_is_converted_to_srgb(tmp_path):
    # The transform of another colour space is Little CMS's own; what is tested is that it is applied, and only then.
    lab = ImageCms.createProfile("LAB")
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    image = Image.fromarray(picture())
    plain = np.float32(picture()) / 255
    assert np.abs(read_back(tmp_path, image, icc_profile=srgb.tobytes()) - plain).max() <= 1 / 255
    for useless in (b"damaged", ImageCms.ImageCmsProfile(lab).tobytes()):
        assert np.array_equal(read_back(tmp_path, image, icc_profile=useless), plain)
    swapped = swap_red_and_blue(srgb.tobytes())
    assert np.abs(read_back(tmp_path, image, icc_profile=swapped)[..., ::-1] - plain).max() <= 2 / 255


def swap_red_and_blue(profile):
    """The sRGB profile with the names of its red and blue primaries exchanged: a colour space of its own."""
    table, rest = profile[:300], profile[300:]
    for old, new in ((b"rXYZ", b"tmp!"), (b"bXYZ", b"rXYZ"), (b"tmp!", b"bXYZ")):
        table = table.replace(old, new, 1)
    return table + rest


def test_the_largest_square_is_cut_from_the_centre(tmp_path):
    wide = np.zeros((32, 96, 3), np.uint8)
    wide[:, 32:64] = picture().repeat(2, 0).repeat(2, 1)
    for image in (wide, wide.transpose(1, 0, 2)):
        middle = image[32:64] if image.shape[0] > 32 else image[:, 32:64]
        assert np.array_equal(read_back(tmp_path, Image.fromarray(image), size=32), np.float32(middle) / 255)


def test_resizing_is_antialiased_and_tiny_images_are_enlarged(tmp_path):
    stripes = np.zeros((160, 160), np.uint8)
    stripes[:, ::2] = 255
    assert np.abs(read_back(tmp_path, Image.fromarray(stripes)) - 0.5).max() < 0.02
    deep = read_back(tmp_path, Image.fromarray(stripes.astype(np.uint16) * 257))
    assert np.abs(deep - 0.5).max() < 0.02
    ramp = np.tile(np.arange(0, 256, 32, dtype=np.uint8), (8, 1))
    large = read_back(tmp_path, Image.fromarray(ramp), size=64)
    assert large.shape == (64, 64, 3)
    assert (np.diff(large[32, 8:56, 0]) >= 0).all()


def test_extreme_shapes_are_read(tmp_path):
    assert read_back(tmp_path, Image.new("RGB", (20_000, 8), "red")).shape == (SIZE, SIZE, 3)


SIDE = 48
PICTURE = Image.fromarray(
    np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8).repeat(3, 0).repeat(3, 1)
)


def refuse(path, match):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(ImageError, match=match) as caught:
            read_photograph(path, SIDE)
    assert not warned
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_images(tmp_path):
    contents = {"a.jpg": b"<html>\nnot found\n</html>", "b.png": b"\0" * 5000, "c.ps": b"%!PS-Adobe-3.0 EPSF-3.0\n"}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        refuse(tmp_path / name, "not an image")
    (tmp_path / "d.jpg").write_bytes(b"")
    refuse(tmp_path / "d.jpg", "empty")
    refuse(tmp_path / "e.jpg", "no such file")
    refuse(tmp_path, "no such file")


@pytest.mark.parametrize(
    "name", ["a.jpg", "p.jpg", "a.png", "a.webp", "a.gif", "a.tif", "lzw.tif", "a.bmp", "a.jp2", "a.ppm"]
)
def test_truncated_files_are_refused_or_complete(tmp_path, name):
    options = {"p.jpg": {"progressive": True}, "lzw.tif": {"compression": "tiff_lzw"}}.get(name, {})
    PICTURE.save(tmp_path / name, **options)
    whole = read_photograph(tmp_path / name, SIDE).image
    data = (tmp_path / name).read_bytes()
    for length in [*range(1, len(data) - 24, max(1, len(data) // 40)), *range(len(data) - 24, len(data))]:
        (tmp_path / name).write_bytes(data[:length])
        try:
            image = read_photograph(tmp_path / name, SIDE).image
        except ImageError:
            continue
        # Some formats end in a mark after the last pixel; a picture without it is whole.
        assert length > len(data) - 24
        assert torch.equal(image, whole)


def test_random_damage_never_raises_anything_else(tmp_path):
    rng = np.random.default_rng(0)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 50
    for name in ("a.jpg", "a.png", "a.gif", "a.tif", "a.webp", "a.ppm", "a.bmp"):
        PICTURE.save(tmp_path / name, exif=exif)
        good = (tmp_path / name).read_bytes()
        for _ in range(40):
            data = bytearray(good)
            for position in rng.integers(0, len(data), 4):
                data[position] = rng.integers(256)
            (tmp_path / name).write_bytes(data)
            try:
                image = read_photograph(tmp_path / name, SIDE).image
            except ImageError:
                continue
            assert image.shape == (3, SIDE, SIDE)
            assert 0 <= image.min() <= image.max() <= 1


@pytest.mark.parametrize("side", [7100, 12_000, 20_000])
def test_bombs_are_refused_before_they_are_decoded(tmp_path, side, monkeypatch):
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    (tmp_path / "a.png").write_bytes(data)
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda self: pytest.fail("decoded"))
    refuse(tmp_path / "a.png", "50,000,000 pixels")


def test_images_of_less_than_8_pixels_are_refused(tmp_path):
    for size in ((7, 100), (100, 7), (1, 1)):
        Image.new("RGB", size).save(tmp_path / "a.png")
        refuse(tmp_path / "a.png", "at least 8")
