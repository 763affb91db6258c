import numpy as np
import pytest
import torch
from image_sheets import cells

from completesplat.export.images import (
    NOTHING,
    SheetCell,
    color_depth,
    color_normals,
    image_grid,
    image_sheet,
    to_pixels,
)


def test_images_stand_where_they_were_given_each_pixel_a_square():
    first = torch.rand(3, 3, 4, 5)
    second = torch.rand(2, 3, 4, 5)
    large = np.asarray(image_grid(first, second, factor=3))
    plain = large[::3, ::3]
    assert large.shape == (24, 45, 3)
    assert np.array_equal(large, plain.repeat(3, axis=0).repeat(3, axis=1))
    for row, images in enumerate((first, second)):
        for column, image in enumerate(images):
            place = plain[4 * row : 4 * row + 4, 5 * column : 5 * column + 5]
            assert np.array_equal(place, to_pixels(image))
    assert np.all(plain[4:, 10:] == 255)


def test_every_image_of_a_sheet_lies_in_its_row_and_column_and_places_may_be_empty():
    images = torch.rand(3, 4, 3, 16, 24)
    rows = [[SheetCell(image, "a label") for image in row] for row in images]
    rows[0][0], rows[2] = None, rows[2][:1]
    expected = images.clone()
    expected[0, 0] = expected[2, 1:] = 1
    result = cells(image_sheet(["one", "two", "three", "four"], rows), 16, 24)
    torch.testing.assert_close(result, expected, atol=0.5 / 255 + 1e-5, rtol=0)


def test_letters_with_accents_and_of_other_alphabets_are_drawn_not_boxes():
    image = [[SheetCell(torch.rand(3, 16, 16))]]
    drawn = [image_sheet(["heading"], image, title).tobytes() for title in "éřкβ→\uffff"]
    assert len(set(drawn)) == len(drawn)


def test_headings_and_labels_are_drawn_and_move_nothing():
    image = torch.rand(3, 16, 16)
    plain = np.asarray(image_sheet(["", ""], [[SheetCell(image), None]])).astype(int)
    named = np.asarray(image_sheet(["", "heading"], [[SheetCell(image, "label"), None]])).astype(int)
    rows, columns = np.nonzero((plain != named).any(-1))
    assert plain.shape == named.shape
    in_heading = (rows < 32) & (columns > 144)
    in_label = (rows >= 32) & (rows < 52) & (columns < 144)
    assert in_heading.any()
    assert in_label.any()
    assert (in_heading | in_label).all()


def test_nearer_is_brighter_on_one_scale_for_all_images():
    colors, (near, far) = color_depth(torch.linspace(1, 20, 100).view(10, 1, 1, 10))
    lightness = (colors * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(-3)
    assert (lightness.flatten().diff() <= 0).all()
    assert 1 <= near < 2
    assert 19 < far <= 20


def test_missing_depths_are_grey_and_stray_depths_hardly_move_the_scale():
    depth = torch.linspace(1, 2, 400).view(1, 20, 20)
    colors, ends = color_depth(depth)
    holes = torch.cat([depth, torch.tensor([0.0, -1, torch.nan, torch.inf]).expand(1, 20, 4)], dim=-1)
    with_holes, same_ends = color_depth(holes)
    assert same_ends == ends
    assert torch.equal(with_holes[..., :20], colors)
    assert (with_holes[..., 20:] == 0.5).all()
    depth[0, 0, 0], depth[0, -1, -1] = 1e-3, 1e6
    torch.testing.assert_close(color_depth(depth)[0][:, 1:-1], colors[:, 1:-1], rtol=0, atol=0.05)


def test_nothing_seen_and_one_depth_are_images_too():
    colors, ends = color_depth(torch.zeros(1, 4, 4))
    assert (colors.shape, ends) == ((3, 4, 4), (0.0, 0.0))
    assert color_depth(torch.full((1, 4, 4), 3.0))[0].isfinite().all()


@pytest.mark.parametrize(
    ("normal", "color"),
    [
        ([0.0, 0, -1], [0.5, 0.5, 1]),  # faces the camera
        ([1.0, 0, 0], [1, 0.5, 0.5]),  # right
        ([0.0, -1, 0], [0.5, 1, 0.5]),  # up
        ([0.0, 0, 0], [NOTHING] * 3),
    ],
)
def test_colors_are_those_of_normal_maps(normal, color):
    result = color_normals(torch.tensor(normal)[:, None, None])
    torch.testing.assert_close(result[:, 0, 0], torch.tensor(color))
