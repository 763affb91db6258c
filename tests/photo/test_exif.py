import math
import struct

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps, TiffImagePlugin

from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import pinhole, project
from completesplat.photo.exif import photo_fov
from completesplat.photo.reading import Framing, read_square

SIZE = 16
RATIONAL = TiffImagePlugin.IFDRational


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_exif_orientation(tmp_path, orientation, name):
    upright = np.random.default_rng(0).integers(0, 256, (2, 3, 3), dtype=np.uint8)
    upright = Image.fromarray(upright.repeat(32, 0).repeat(32, 1))
    # The inverse of what the orientation asks for gives the stored image (5 to 8 are wider than high when upright).
    exif = Image.Exif()
    exif[0x0112] = {6: 8, 8: 6}.get(orientation, orientation)
    upright.info["exif"] = exif.tobytes()
    stored = ImageOps.exif_transpose(upright)
    exif[0x0112] = orientation
    stored.info.clear()
    stored.save(tmp_path / name, exif=exif)
    got = read_square(tmp_path / name, Framing(64), crop="center").image.permute(1, 2, 0).numpy()
    assert np.array_equal(got, np.float32(upright)[:, 16:80] / 255)


NUMBERS = {"equivalent": 0xA405, "focal": 0x920A, "width": 0xA002, "height": 0xA003}
NUMBERS |= {"resolution": 0xA20E, "unit": 0xA210}


def exif_of(**tags):
    exif = Image.Exif()
    exif[0x010F] = "maker"  # Pillow writes no record that holds nothing but the inner one
    for name, value in tags.items():
        exif.get_ifd(0x8769)[NUMBERS[name]] = value
    return exif


def fov_of(tmp_path, exif, size=(60, 40), name="a.jpg", default=50.0, given=None, crop="center"):
    # Pillow does not store the inner record of an Exif object in a TIFF, but does so for a plain mapping.
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[0x8769] = dict(exif.get_ifd(0x8769))
    options_for_tiff = {"tiffinfo": tags} if name == "a.tif" else {"exif": exif}
    Image.new("RGB", size).save(tmp_path / name, **options_for_tiff)
    return read_square(tmp_path / name, Framing(SIZE, default), given, crop=crop)


def degrees(millimetres, focal):
    return math.degrees(2 * math.atan(millimetres / 2 / focal))


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_full_frame_focal_length_gives_the_field_of_view_of_the_square(tmp_path, name):
    for size, focal, seen in (((60, 40), 50, 24), ((40, 60), 50, 24), ((80, 80), 28, 36), ((80, 60), 28, 27)):
        photograph = fov_of(tmp_path, exif_of(equivalent=focal), size, name)
        assert photograph.fov_source == "exif"
        assert photograph.fov_degrees == pytest.approx(degrees(seen, focal))
    photograph = fov_of(tmp_path, exif_of(equivalent=50), name=name, given=33.0, crop="whole")
    assert (photograph.fov_degrees, photograph.fov_source) == (pytest.approx(33), "given")
    photograph = fov_of(tmp_path, exif_of(equivalent=50), name=name, given=33.0)
    assert photograph.fov_degrees == pytest.approx(degrees(2 / 3 * 36, 18 / math.tan(math.radians(33) / 2)))


@pytest.mark.parametrize("size", [(60, 40), (40, 60), (40, 40), (40, 160)])
@pytest.mark.parametrize("crop", ["whole", "center", [0.25, 0.1, 0.5]])
def test_a_point_is_seen_where_the_known_camera_of_the_whole_photo_sees_it(tmp_path, tiny_weights, size, crop):
    """Whatever is taken of the photo: the square's camera has the photo's focal length and axis."""
    model = CompleteSplat.from_pretrained(tiny_weights)
    Image.new("RGB", size).save(tmp_path / "a.jpg", exif=exif_of(equivalent=28))
    photograph = model.read(tmp_path / "a.jpg", crop=crop)
    camera = model.camera(photograph)
    focal = 28 / 36 * max(size)
    points = torch.tensor([[0.1, -0.2, 2.0], [-0.3, 0.1, 1.0]])
    known = points[:, :2] / points[:, 2:] * focal + torch.tensor(size) / 2
    left, top, right, _ = photograph.window
    expected = (known - torch.tensor([left, top])) * model.image_size / (right - left)
    torch.testing.assert_close(project(camera, points)[0], expected, rtol=1e-4, atol=1e-3)
    unknown = model.camera(model.read(Image.new("RGB", size), crop=crop)).intrinsics
    torch.testing.assert_close(unknown, pinhole(model.fov_degrees.item(), model.image_size))


def test_focal_length_with_the_resolution_of_the_sensor(tmp_path):
    # 6000 x 4000 px on a sensor of 36 x 24 mm, stored at 1/100 of that size.
    sensor = {"focal": RATIONAL(35), "width": 6000, "height": 4000}
    for tags in (
        {**sensor, "resolution": RATIONAL(int(6000 / 36 * 25.4 * 1000), 1000), "unit": 2},
        {**sensor, "resolution": RATIONAL(int(6000 / 36 * 10 * 1000), 1000), "unit": 3},
        {"focal": RATIONAL(35), "resolution": RATIONAL(60, 36), "unit": 4},
    ):
        assert fov_of(tmp_path, exif_of(**tags)).fov_degrees == pytest.approx(degrees(24, 35), rel=1e-4)


def test_without_a_usable_focal_length_the_default_stands(tmp_path):
    useless = [{}, {"equivalent": 0}, {"equivalent": 60_000}, {"focal": RATIONAL(4)}]
    useless += [{"focal": RATIONAL(0, 0), "resolution": RATIONAL(100)}]
    useless += [{"focal": RATIONAL(4), "resolution": RATIONAL(100), "unit": 1}]
    for tags in useless:
        photograph = fov_of(tmp_path, exif_of(**tags), default=61.0)
        assert (photograph.fov_degrees, photograph.fov_source) == (61.0, "default"), tags
    infinite = {0x920A: 35.0, 0xA20E: 100.0, 0xA002: math.inf, 0xA003: math.inf}
    assert photo_fov(infinite, (60, 40)) == pytest.approx(degrees(60, 35 * 100 / 25.4))
    assert photo_fov({0xA405: math.inf}, (60, 40)) is None


def test_a_damaged_inner_record_leaves_the_orientation(tmp_path):
    # Two entries: orientation 3, and an inner record at a position beyond the end.
    entries = struct.pack(">HHHIHHHHII", 2, 0x0112, 3, 1, 3, 0, 0x8769, 4, 1, 60_000)
    levels = np.zeros((SIZE, SIZE), np.uint8)
    levels[0] = 255
    Image.fromarray(levels).save(tmp_path / "a.png", exif=b"Exif\0\0MM\0*\0\0\0\x08" + entries + bytes(4))
    photograph = read_square(tmp_path / "a.png", Framing(SIZE))
    assert photograph.image[:, -1].min() == 1
    assert photograph.fov_source == "default"
