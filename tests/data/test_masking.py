from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.data.images.photograph import outside_of_box, outside_of_mask, read_photograph
from completesplat.errors import CompleteSplatError, ImageError

SHIPPED = (0.25, 0.5, 0.75, 1.0)


@pytest.fixture
def photos(tmp_path):
    """Two photographs (width, height) that differ in a box of their central square, and a mask of that box."""

    def write(width: int, height: int) -> tuple[Path, Path, Path]:
        rng = np.random.default_rng(0)
        first, second = (rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(2))
        side = min(width, height)
        left, top = (width - side) // 2, (height - side) // 2
        inside = np.zeros((height, width), dtype=bool)
        x0, y0, x1, y1 = (round(edge * side) for edge in SHIPPED)
        inside[top + y0 : top + y1, left + x0 : left + x1] = True
        second[~inside] = first[~inside]
        paths = tuple(tmp_path / f"{name}.png" for name in ("first", "second", "mask"))
        for path, pixels in zip(paths, (first, second, np.uint8(255) * inside), strict=True):
            Image.fromarray(pixels).save(path)
        return paths

    return write


@pytest.mark.parametrize("form", ["box", "mask"])
@pytest.mark.parametrize("size", [(32, 32), (100, 80), (61, 97), (20, 24)])
def test_no_visible_pixel_holds_anything_hidden(photos, size, form):
    first, second, mask = photos(*size)
    visible = outside_of_box(first, SHIPPED, 32) if form == "box" else outside_of_mask(first, mask, 32)
    images = [read_photograph(path, 32).image for path in (first, second)]
    assert torch.equal(images[0] * visible, images[1] * visible)
    assert not torch.equal(images[0], images[1])
    assert visible.unique().tolist() == [0, 1]


def test_an_image_of_the_right_size_is_hidden_to_the_pixel_and_others_three_pixels_more_at_most(photos):
    expected, grown = torch.ones(2, 1, 32, 32)
    expected[:, 16:, 8:24] = 0
    grown[:, 13:, 5:27] = 0
    first, _, mask = photos(32, 32)
    assert torch.equal(outside_of_box(first, SHIPPED, 32), expected)
    assert torch.equal(outside_of_mask(first, mask, 32), expected)
    assert torch.equal(outside_of_box(photos(640, 640)[0], SHIPPED, 32), grown)


def test_boxes_and_masks_that_are_none_are_refused(photos, tmp_path):
    first = photos(32, 32)[0]
    for box in ((0, 0, 1), (0, 0, 0, 1), (0.5, 0, 0.4, 1), (-0.1, 0, 1, 1), (0, 0, 1, 1.1)):
        with pytest.raises(CompleteSplatError, match="box="):
            outside_of_box(first, box, 32)
    Image.new("L", (32, 32)).save(tmp_path / "black.png")
    with pytest.raises(CompleteSplatError, match=r"black.png: hides nothing"):
        outside_of_mask(first, tmp_path / "black.png", 32)
    with pytest.raises(ImageError, match=r"nowhere.png: no such file"):
        outside_of_mask(first, tmp_path / "nowhere.png", 32)
