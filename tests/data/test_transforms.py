"""Decoding and cropping of pictures."""

import numpy as np
import pytest
from PIL import Image

from completesplat.data.pictures.crop import Square, read_square
from completesplat.errors import DataError


@pytest.fixture
def ramp(tmp_path):
    """A 20 x 30 picture (height x width) whose value is four times the column plus five times the row."""
    column, row = np.meshgrid(np.arange(30), np.arange(20))
    path = tmp_path / "ramp.png"
    Image.fromarray((4 * column + 5 * row).astype(np.uint8)).save(path)
    return path


def test_a_whole_pixel_crop_without_resizing_is_a_slice(ramp):
    pixels = read_square(ramp, (20, 30), Square(7, 3, 10), 10, "L")
    column, row = np.meshgrid(np.arange(7, 17), np.arange(3, 13))
    assert np.array_equal(pixels[0].numpy(), 4 * column + 5 * row)


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_a_subpixel_crop_of_a_linear_picture_keeps_to_the_plane(ramp, mode):
    """Pixel centres of the crop lie at left + (i + 0.5) side / size of the file, whose centres lie at i + 0.5."""
    left, top, side, size = 6.3, 2.6, 15.0, 12
    pixels = read_square(ramp, (20, 30), Square(left, top, side), size, mode).numpy()
    centers = (np.arange(size) + 0.5) * side / size - 0.5
    expected = 4 * (left + centers)[None, :] + 5 * (top + centers)[:, None]
    assert pixels.shape == (3 if mode == "RGB" else 1, size, size)
    inner = (slice(2, -2), slice(2, -2))
    # Less than half a pixel's rise along one axis; Pillow's discrete filters are not exact on a plane.
    assert np.abs(pixels[0][inner] - expected[inner]).max() < 1.6


def test_unreadable_pictures_are_refused_by_name(tmp_path, ramp):
    (tmp_path / "page.jpg").write_text("<html>")
    (tmp_path / "half.png").write_bytes(ramp.read_bytes()[:-40])
    for name in ("page.jpg", "half.png", "missing.png"):
        with pytest.raises(DataError, match=name):
            read_square(tmp_path / name, (20, 30), Square(0, 0, 20), 8, "RGB")
    with pytest.raises(DataError, match=r"ramp\.png"):
        read_square(ramp, (30, 20), Square(0, 0, 20), 8, "RGB")
