"""What is visible of photos that a box or a mask hides in part."""

import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.photo.reading import Framing, read_square
from completesplat.photo.visible import outside_of_box, outside_of_mask, visible_part

HIDDEN = (0.25, 0.5, 0.75, 1.0)


@pytest.fixture
def photos(tmp_path):
    """Two photographs (width, height) that differ in a box, and a mask of that box."""

    def write(width: int, height: int) -> tuple[Path, Path, Path]:
        rng = np.random.default_rng(0)
        first, second = (rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(2))
        inside = np.zeros((height, width), dtype=bool)
        x0, y0, x1, y1 = HIDDEN
        inside[int(y0 * height) : math.ceil(y1 * height), int(x0 * width) : math.ceil(x1 * width)] = True
        second[~inside] = first[~inside]
        paths = tuple(tmp_path / f"{name}.png" for name in ("first", "second", "mask"))
        for path, pixels in zip(paths, (first, second, np.uint8(255) * inside), strict=True):
            Image.fromarray(pixels).save(path)
        return paths

    return write


@pytest.mark.parametrize("crop", ["whole", "center", [0.2, 0.2, 0.6]])
@pytest.mark.parametrize("form", ["box", "mask"])
@pytest.mark.parametrize("size", [(32, 32), (100, 80), (61, 97), (20, 24)])
def test_no_visible_pixel_holds_anything_hidden(photos, size, form, crop):
    """Also not the border that continues it."""
    first, second, mask = photos(*size)
    photos_read = [read_square(path, Framing(32), crop=crop) for path in (first, second)]
    visible = outside_of_box(photos_read[0], HIDDEN) if form == "box" else outside_of_mask(photos_read[0], mask)
    assert torch.equal(photos_read[0].image * visible, photos_read[1].image * visible)
    assert not torch.equal(photos_read[0].image, photos_read[1].image)
    assert visible.unique().tolist() == [0, 1]


def test_an_image_of_the_right_size_is_hidden_to_the_pixel_and_others_three_pixels_more_at_most(photos):
    expected, grown = torch.ones(2, 1, 32, 32)
    expected[:, 16:, 8:24] = 0
    grown[:, 13:, 5:27] = 0
    first, _, mask = photos(32, 32)
    photograph = read_square(first, Framing(32))
    assert torch.equal(outside_of_box(photograph, HIDDEN), expected)
    assert torch.equal(outside_of_mask(photograph, mask), expected)
    white = Image.new("LA", (32, 32), (255, 0))  # as a paint program saves white strokes
    white.putalpha(Image.open(mask).convert("L"))
    white.save(mask)
    assert torch.equal(outside_of_mask(photograph, mask), expected)
    large = read_square(photos(640, 640)[0], Framing(32))
    assert torch.equal(outside_of_box(large, HIDDEN), grown)


def test_boxes_and_masks_that_are_none_are_refused(photos, tmp_path):
    photograph = read_square(photos(32, 32)[0], Framing(32))
    for box in ((0, 0, 1), (0, 0, 0, 1), (0.5, 0, 0.4, 1), (-0.1, 0, 1, 1), (0, 0, 1, 1.1)):
        with pytest.raises(CompleteSplatError, match="box="):
            outside_of_box(photograph, box)
    Image.new("L", (32, 32)).save(tmp_path / "black.png")
    Image.new("L", (32, 32), 255).save(tmp_path / "white.png")
    Image.new("L", (32, 64), 255).save(tmp_path / "tall.png")
    for hide in (partial(outside_of_mask, mask=tmp_path / "white.png"), partial(outside_of_box, box=(0, 0, 1, 1))):
        with pytest.raises(CompleteSplatError, match="the whole photo is hidden"):
            hide(photograph)
    corner = read_square(photos(32, 32)[0], Framing(32), crop=[0, 0, 0.25])
    with pytest.raises(CompleteSplatError, match="hides nothing of what crop= takes"):
        outside_of_box(corner, HIDDEN)
    with pytest.raises(CompleteSplatError, match=r"tall.png: 32 x 64 pixels, another shape than the photo's"):
        outside_of_mask(photograph, tmp_path / "tall.png")
    with pytest.raises(CompleteSplatError, match=r"black.png: hides nothing"):
        outside_of_mask(photograph, tmp_path / "black.png")
    with pytest.raises(ImageError, match=r"nowhere.png: no such file"):
        outside_of_mask(photograph, tmp_path / "nowhere.png")


def test_what_hides_nothing_is_refused(tmp_path):
    photograph = read_square(Image.new("RGB", (32, 32)), Framing(32))
    for mask, box, message in (
        (None, [0, 0, 1], "box=[0, 0, 1]: give [x0,y0,x1,y1]"),
        (None, [0.5, 0, 0.5, 1], "needs 0 <= x0 < x1 <= 1"),
        ("nowhere.png", None, "nowhere.png: no such file"),
        ("nowhere.png", [0.5, 0, 1, 1], "not both"),
    ):
        with pytest.raises(CompleteSplatError, match=re.escape(message)):
            visible_part(photograph, mask, box)
    assert visible_part(photograph, None, None) is None
