import math
import struct
import warnings

import cv2
import jaxtyping
import numpy as np
import pytest
import torch
from PIL import Image, ImageCms

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.photo import files
from completesplat.photo.crop import square_within, window_of
from completesplat.photo.reading import Framing, read_square

SIZE = 16


def photo(seed=0):
    """Random bytes, 16 x 16: read with size 16 nothing is resampled, so every pixel can be compared."""
    return np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)


def read_back(tmp_path, image, name="a.png", size=SIZE, crop="center", **options):
    image.save(tmp_path / name, **options)
    return pixels(tmp_path / name, size, crop)


def pixels(path, size=SIZE, crop="center"):
    image = read_square(path, Framing(size), crop=crop).image
    assert image.dtype == torch.float32
    assert 0 <= image.min() <= image.max() <= 1
    return image.permute(1, 2, 0).numpy()


def grey_tiff(values, bits, photometric=1):
    """A grey little-endian TIFF of one strip, written by hand."""
    data = values.tobytes()
    tags = [(256, 3, SIZE), (257, 3, SIZE), (258, 3, bits), (259, 3, 1), (262, 3, photometric), (273, 4, 8)]
    tags += [(277, 3, 1), (278, 3, SIZE), (279, 4, len(data))]
    directory = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", len(tags)) + directory + bytes(4)


def twelve_bits(values):
    first, second = values.ravel()[::2], values.ravel()[1::2]
    return np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], -1).astype(np.uint8)


def over_white(color, alpha):
    return color * alpha + 1 - alpha


def white_at(image, where):
    return np.where(where[..., None], 1, image)


def grey(values):
    return values[..., None].repeat(3, -1)


RGB, ALPHA = photo(), photo(1)[..., :1]
GREY, INKS = RGB[..., 0], np.concatenate([RGB, ALPHA // 2], -1)
SMOOTH = Image.fromarray(RGB).resize((4, 4)).resize((SIZE, SIZE), Image.Resampling.BICUBIC)
DEEP = np.linspace(0, 65535, SIZE * SIZE).astype(np.uint16).reshape(SIZE, SIZE)
TWELVE = DEEP // 16
DEEP_COLOR = np.random.default_rng(0).integers(0, 65536, (SIZE, SIZE, 3), dtype=np.uint16)  # BGR
FLOAT = np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32)
INDEX = np.arange(SIZE * SIZE, dtype=np.uint8).reshape(SIZE, SIZE)
COLORS = photo(2).reshape(256, 3)
PALETTE = Image.fromarray(INDEX, "P")
PALETTE.putpalette(COLORS.tobytes())
ONE = np.arange(SIZE * SIZE).reshape(SIZE, SIZE) == 53
FLAT = Image.new("CMYK", (SIZE, SIZE), (40, 200, 90, 30))

# name: (file's name, image or content, expected, tolerance, options of saving)
FILES = {
    "rgb": ("a.png", RGB, RGB / 255, 1e-6, {}),
    "ycbcr": ("a.tif", SMOOTH.convert("YCbCr"), np.asarray(SMOOTH) / 255, 4 / 255, {}),
    "grey": ("a.png", GREY, grey(GREY / 255), 1e-6, {}),
    "alpha": ("a.png", np.concatenate([RGB, ALPHA], -1), over_white(RGB / 255, ALPHA / 255), 1 / 255, {}),
    "grey with alpha": (
        "a.png", Image.fromarray(np.dstack([GREY, ALPHA]), "LA"), over_white(grey(GREY / 255), ALPHA / 255), 1 / 255, {}
    ),
    "palette": ("a.png", PALETTE, COLORS[INDEX] / 255, 1e-6, {}),
    "transparent palette": (
        "a.png", PALETTE, white_at(COLORS[INDEX] / 255, INDEX == 7), 1e-6, {"transparency": 7}
    ),
    "transparent colour": (
        "a.png", RGB, white_at(RGB / 255, ONE), 1e-6, {"transparency": tuple(RGB[ONE][0].tolist())}
    ),
    "transparent deep grey": (
        "a.png", DEEP, white_at(grey(DEEP / 65535), ONE), 1e-6, {"transparency": int(DEEP[ONE][0])}
    ),
    "cmyk": (
        "a.tif", Image.fromarray(INKS, "CMYK"), (1 - INKS[..., :3] / 255) * (1 - INKS[..., 3:] / 255), 1.5 / 255, {}
    ),
    "cmyk JPEG": ("a.jpg", FLAT, np.array([215, 55, 165]) / 255 * 225 / 255, 4 / 255, {"quality": 100}),
    "deep grey PNG": ("a.png", DEEP, grey(DEEP / 65535), 1e-6, {}),
    "deep grey TIFF of 32 bits": ("a.tif", DEEP.astype("<i4"), grey(DEEP / 65535), 1e-6, {}),
    "deep colour": ("a.png", cv2.imencode(".png", DEEP_COLOR)[1].tobytes(), DEEP_COLOR[..., ::-1] / 65535, 2 / 255, {}),
    "deep PGM": ("a.pgm", DEEP, grey(DEEP / 65535), 1e-4, {}),
    "TIFF whose zero is white": ("a.tif", grey_tiff(DEEP, 16, photometric=0), grey(1 - DEEP / 65535), 1e-6, {}),
    "TIFF of twelve bits": ("a.tif", grey_tiff(twelve_bits(TWELVE), 12), grey(TWELVE / 4095), 1e-6, {}),
    "floats": ("a.tif", FLOAT, grey(FLOAT), 1e-6, {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
def test_files_give_their_images(tmp_path, kind):
    """Nothing is clipped that can be scaled, and transparency lies over white."""
    name, content, expected, tolerance, options = FILES[kind]
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    else:
        (Image.fromarray(content) if isinstance(content, np.ndarray) else content).save(tmp_path / name, **options)
    assert np.abs(pixels(tmp_path / name) - expected).max() <= tolerance


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
    lab, srgb = (ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes() for name in ("LAB", "sRGB"))
    image, plain = Image.fromarray(RGB), np.float32(RGB) / 255
    assert np.abs(read_back(tmp_path, image, icc_profile=srgb) - plain).max() <= 1 / 255
    for useless in (b"damaged", lab):
        assert np.array_equal(read_back(tmp_path, image, icc_profile=useless), plain)
    # The names of its red and blue primaries are exchanged: a colour space of its own.
    swapped = srgb
    for old, new in ((b"rXYZ", b"tmp!"), (b"bXYZ", b"rXYZ"), (b"tmp!", b"bXYZ")):
        swapped = swapped.replace(old, new, 1)
    assert np.abs(read_back(tmp_path, image, icc_profile=swapped)[..., ::-1] - plain).max() <= 2 / 255


def test_the_largest_square_is_cut_from_the_centre_of_any_shape(tmp_path):
    wide = np.zeros((32, 96, 3), np.uint8)
    wide[:, 32:64] = photo().repeat(2, 0).repeat(2, 1)
    for image in (wide, wide.transpose(1, 0, 2)):
        middle = image[32:64] if image.shape[0] > 32 else image[:, 32:64]
        assert np.array_equal(read_back(tmp_path, Image.fromarray(image), size=32), np.float32(middle) / 255)
    assert read_back(tmp_path, Image.new("RGB", (20_000, 8), "red")).shape == (SIZE, SIZE, 3)


def test_a_whole_image_lies_in_the_middle_of_its_square_whose_border_is_continued(tmp_path):
    high = photo()[:, 4:12].repeat(2, 0).repeat(2, 1)  # 32 high, 16 wide
    for turned in (False, True):
        image = high.transpose(1, 0, 2) if turned else high
        got = read_back(tmp_path, Image.fromarray(image), size=32, crop="whole")
        got = got.transpose(1, 0, 2) if turned else got
        assert np.array_equal(got[:, 8:24], np.float32(high) / 255)
        border = got[:, [*range(8), *range(24, 32)]]
        assert 0 < np.abs(border.mean((0, 1)) - high[:, [0, -1]].mean((0, 1)) / 255).max() < 0.05
    line = np.full((8, 30, 3), 255, np.uint8)
    line[:, 3:27] = [255, 0, 0]
    read = read_square(line, Framing(24))
    assert (read.window, read.part) == ((3, -8, 27, 16), (0, pytest.approx(1 / 3), 1, pytest.approx(2 / 3)))
    assert read.image[1].max() == 0  # of what is longer than 3:1 the ends are missing


def test_a_given_square_is_cut_and_others_are_refused():
    image = photo().repeat(4, 0).repeat(8, 1)  # 64 high, 128 wide
    read = read_square(image, Framing(32), crop=[0.5, 0.25, 0.5])
    assert read.window == (64, 16, 96, 48)
    assert torch.equal(read.image, torch.from_numpy(image[16:48, 64:96]).permute(2, 0, 1) / 255)
    assert read_square(image, Framing(32), crop=[0.5, 0, 1]).window == (64, 0, 128, 64)
    for crop in ([0.8, 0, 1], [-0.1, 0, 0.5], [0, 0.6, 0.5], [0, 0, 0.1], [0, 0, 1.1], [math.nan, 0, 0.5]):
        with pytest.raises(CompleteSplatError, match=r"give \[x,y,size\], in shares of width, height and shorter side"):
            read_square(image, Framing(32), crop=crop)


@pytest.mark.parametrize("size", [(64, 64), (203, 64), (47, 160), (8, 23)])
def test_any_square_is_moved_into_the_photo_and_one_within_stays(size):
    for square in ((-1, -1, -1), (2, 2, 2), (0.9, 0.1, 0.7), (0.1, 0.9, 0.7), (0, 0, 1), (1, 0, 1)):
        within = square_within(size, square)
        left, top, right, lower = window_of(size, within)
        assert left >= 0
        assert top >= 0
        assert right <= size[0]
        assert lower <= size[1]
        assert right - left == lower - top >= 8
    inner = (0.25, 0.125, 0.5)
    assert square_within((64, 128), inner) == inner
    assert window_of((128, 64), square_within((128, 64), (0.9, 0.9, 0.5))) == (96, 32, 128, 64)


def test_what_is_the_photos_own_is_known_at_each_size_and_the_rest_is_pale():
    read = read_square(np.zeros((64, 48, 3), np.uint8), Framing(16))
    assert read.part == (0.125, 0, 0.875, 1)
    own = read.own_at(8)
    assert torch.equal(own, torch.tensor([0.0, 1, 1, 1, 1, 1, 1, 0]).expand(1, 8, 8))
    assert read.own_at(64).sum() == 64 * 48
    assert torch.equal(read.shown_at(8)[:1] > 0, own == 0)
    assert read_square(np.zeros((16, 16, 3), np.uint8), Framing(16)).own_at(8) is None
    bright = np.full((64, 64, 3), 255, np.uint8)
    bright[:, :16] = 0
    assert read_square(bright[:, 16:], Framing(16)).middle_at(8).min() == 1


def test_resizing_is_antialiased_and_tiny_images_are_enlarged(tmp_path):
    stripes = np.zeros((160, 160), np.uint8)
    stripes[:, ::2] = 255
    for image in (stripes, stripes.astype(np.uint16) * 257):
        assert np.abs(read_back(tmp_path, Image.fromarray(image)) - 0.5).max() < 0.02
    ramp = np.tile(np.arange(0, 256, 32, dtype=np.uint8), (8, 1))
    large = read_back(tmp_path, Image.fromarray(ramp), size=64)
    assert large.shape == (64, 64, 3)
    assert (np.diff(large[32, 8:56, 0]) >= 0).all()


SIDE = 48
PHOTO = Image.fromarray(RGB.repeat(3, 0).repeat(3, 1))


def refuse(path, match):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(ImageError, match=match) as caught:
            read_square(path, Framing(SIDE))
    assert not warned
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_photograph_is_refused(tmp_path, monkeypatch):
    contents = {"a.jpg": b"<html>\nnot found\n</html>", "c.ps": b"%!PS-Adobe-3.0 EPSF-3.0\n", "d.jpg": b""}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        refuse(tmp_path / name, "not an image" if content else "empty")
    (tmp_path / "f.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    refuse(tmp_path / "f.HEIC", "not an image")
    refuse(tmp_path / "e.jpg", "no such file")
    refuse(tmp_path, "a folder; give a file")
    for size in ((7, 100), (100, 7)):
        Image.new("RGB", size).save(tmp_path / "a.png")
        refuse(tmp_path / "a.png", "at least 8")
    monkeypatch.setattr(files, "MOST_PIXELS", SIDE**2 - 1)
    PHOTO.save(tmp_path / "a.png")
    refuse(tmp_path / "a.png", "2,303 pixels")


@pytest.mark.parametrize("name", ["p.jpg", "a.png", "a.gif", "lzw.tif", "a.jp2"])
def test_truncated_files_are_refused_or_complete(tmp_path, name):
    options = {"p.jpg": {"progressive": True}, "lzw.tif": {"compression": "tiff_lzw"}}.get(name, {})
    PHOTO.save(tmp_path / name, **options)
    whole = read_square(tmp_path / name, Framing(SIDE)).image
    data = (tmp_path / name).read_bytes()
    for length in [*range(1, len(data) - 24, max(1, len(data) // 40)), *range(len(data) - 24, len(data))]:
        (tmp_path / name).write_bytes(data[:length])
        try:
            image = read_square(tmp_path / name, Framing(SIDE)).image
        except ImageError:
            continue
        # Some formats end in a mark after the last pixel; an image without it is whole.
        assert length > len(data) - 24
        assert torch.equal(image, whole)


def test_images_in_memory_are_read_as_files_are(tmp_path):
    wide = np.random.default_rng(1).integers(0, 256, (40, 56, 3), dtype=np.uint8)
    file = read_back(tmp_path, Image.fromarray(wide))
    for of_bytes in (Image.fromarray(wide), wide, torch.from_numpy(wide).permute(2, 0, 1)):
        np.testing.assert_array_equal(pixels(of_bytes), file)
    share = np.linspace(0.1, 0.9, 40 * 56 * 3, dtype=np.float32).reshape(40, 56, 3)
    bright = pixels((share * 255).round().astype(np.uint8))
    for of_floats in (share, share.astype(np.float64), torch.from_numpy(share).permute(2, 0, 1)):
        np.testing.assert_allclose(pixels(of_floats), bright, atol=1 / 255)
    rounded = torch.from_numpy(share).permute(2, 0, 1).bfloat16()
    np.testing.assert_array_equal(pixels(rounded), pixels(rounded.float()))


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (np.zeros((3, 16, 16), dtype=np.uint8), "arrays are"),
        (torch.zeros(16, 16, 3), "tensors"),
        (np.zeros((16, 16), dtype=np.uint8), "in shape"),
        (np.full((16, 16, 3), 255.0), "outside of"),
        (np.full((16, 16, 3), np.nan), "outside of"),
        (np.zeros((16, 16, 3), dtype=np.int64), "int64"),
        (np.zeros((4, 16, 3), dtype=np.uint8), "at least 8"),
        (Image.new("RGB", (4, 16)), "at least 8"),
    ],
)
def test_images_in_memory_without_one_plain_meaning_are_refused(wrong, reason):
    with pytest.raises(ImageError, match=reason):
        read_square(wrong, Framing(SIZE))


@pytest.mark.parametrize("fov", [1e-300, 0, -5, math.nextafter(180, 0), 200, float("nan")])
def test_fields_of_view_that_no_lens_has_are_refused(fov):
    """Of 1e-300 degrees the focal length is infinite in float32; of nearly 180 it is negative."""
    for framing, given in ((Framing(SIZE), fov), (Framing(SIZE, fov), None)):
        with pytest.raises(CompleteSplatError, match=r"must lie between 0\.1 and 179 degrees, not "):
            read_square(RGB, framing, given)
    for edge in (0.1, 179):
        assert read_square(RGB, Framing(SIZE), edge).fov_degrees == edge


@pytest.mark.parametrize("source", [None, 5, [[1, 2], [3, 4]], b"a.png", {"image": "a.png"}])
def test_what_is_neither_a_file_nor_pixels_is_refused(source, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users have no type checker at run time
    with pytest.raises(ImageError, match=f"{type(source).__name__}: give a file name, a PIL image, an array or a"):
        read_square(source, Framing(SIZE))


def test_the_square_is_kept_with_the_photos_own_pixels():
    pixels = torch.randint(256, (3, 30, 40), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    photograph = read_square(pixels, Framing(SIDE), crop="center")
    assert photograph.square.size == (30, 30)
    assert torch.equal(photograph.square_at(30), pixels[..., 5:35].float() / 255)
    assert torch.equal(photograph.square_at(SIDE), photograph.image)


def test_deep_grey_keeps_its_depth_in_the_square():
    values = np.linspace(0, 1, 20 * 20, dtype=np.float32).reshape(20, 20)
    photograph = read_square(Image.fromarray(values), Framing(SIDE))
    assert photograph.square_at(20).shape == (3, 20, 20)
    np.testing.assert_allclose(photograph.square_at(20)[0], values, atol=1e-6)
