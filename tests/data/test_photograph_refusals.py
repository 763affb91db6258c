import struct
import warnings
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, ImageFile

from completesplat.data.pictures.photograph import read_photograph
from completesplat.errors import ImageError

SIZE = 48
PICTURE = Image.fromarray(
    np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8).repeat(3, 0).repeat(3, 1)
)


def refuse(path, match):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(ImageError, match=match) as caught:
            read_photograph(path, SIZE)
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
    whole = read_photograph(tmp_path / name, SIZE).image
    data = (tmp_path / name).read_bytes()
    for length in [*range(1, len(data) - 24, max(1, len(data) // 40)), *range(len(data) - 24, len(data))]:
        (tmp_path / name).write_bytes(data[:length])
        try:
            image = read_photograph(tmp_path / name, SIZE).image
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
                image = read_photograph(tmp_path / name, SIZE).image
            except ImageError:
                continue
            assert image.shape == (3, SIZE, SIZE)
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
