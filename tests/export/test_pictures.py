"""Tensors as pictures: bytes, grids, sheets, and the colours of depth and normals."""

import numpy as np
import pytest
import torch
from picture_sheets import cells

from completesplat.export.pictures import (
    NOTHING,
    SheetCell,
    color_depth,
    color_normals,
    image_grid,
    picture_sheet,
    to_bytes,
)


def test_images_stand_where_they_were_given_each_pixel_a_square():
    first, second = torch.rand(3, 3, 4, 5), torch.rand(2, 3, 4, 5)
    large = np.asarray(image_grid(first, second, factor=3))
    picture = large[::3, ::3]
    assert large.shape == (24, 45, 3)
    assert np.array_equal(large, picture.repeat(3, axis=0).repeat(3, axis=1))
    for row, images in enumerate((first, second)):
        for column, image in enumerate(images):
            place = picture[4 * row : 4 * row + 4, 5 * column : 5 * column + 5]
            assert np.array_equal(place, to_bytes(image))
    assert np.all(picture[4:, 10:] == 255)


def test_every_picture_of_a_sheet_lies_in_its_row_and_column():
    images = torch.rand(3, 4, 3, 16, 24)
    rows = [[SheetCell(image, "a label") for image in row] for row in images]
    found = cells(picture_sheet(["one", "two", "three", "four"], rows), 16, 24)
    assert found.shape == images.shape
    torch.testing.assert_close(found, images, atol=0.5 / 255 + 1e-5, rtol=0)


def test_a_place_may_be_empty_and_a_row_short():
    first, last = SheetCell(torch.rand(3, 16, 16)), SheetCell(torch.rand(3, 16, 16))
    found = cells(picture_sheet(["", "", ""], [[None, first, last], [first]]), 16, 16)
    assert found.shape[:2] == (2, 3)
    for row, column in ((0, 0), (1, 1), (1, 2)):
        assert (found[row, column] == 1).all()
    assert torch.equal(found[1, 0], found[0, 1])


def test_headings_and_labels_are_drawn_and_move_nothing():
    image = torch.rand(3, 16, 16)
    plain = np.asarray(picture_sheet(["", ""], [[SheetCell(image), None]])).astype(int)
    named = np.asarray(picture_sheet(["", "heading"], [[SheetCell(image, "label"), None]])).astype(int)
    rows, columns = np.nonzero((plain != named).any(-1))
    assert plain.shape == named.shape
    in_heading, in_label = (rows < 32) & (columns > 144), (rows >= 32) & (rows < 52) & (columns < 144)
    assert in_heading.any()
    assert in_label.any()
    assert (in_heading | in_label).all()


def lightness(colors):
    return (colors * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(-3)


def test_nearer_is_brighter_on_one_scale_for_all_pictures():
    colors, (near, far) = color_depth(torch.linspace(1, 20, 100).view(10, 1, 1, 10))
    assert (lightness(colors).flatten().diff() <= 0).all()
    assert 1 <= near < 2
    assert 19 < far <= 20


def test_what_is_not_seen_is_grey_and_does_not_move_the_scale():
    depth = torch.rand(2, 1, 8, 8) + 1
    colors, ends = color_depth(depth)
    holes = torch.cat([depth, torch.tensor([0.0, -1, torch.nan, torch.inf]).expand(2, 1, 8, 4)], dim=-1)
    with_holes, same_ends = color_depth(holes)
    assert same_ends == ends
    assert torch.equal(with_holes[..., :8], colors)
    assert (with_holes[..., 8:] == 0.5).all()


def test_stray_depths_do_not_flatten_the_rest():
    depth = torch.linspace(1, 2, 400).view(1, 20, 20)
    stray = depth.clone()
    stray[0, 0, 0], stray[0, -1, -1] = 1e-3, 1e6
    plain, with_stray = color_depth(depth)[0], color_depth(stray)[0]
    torch.testing.assert_close(with_stray[:, 1:-1], plain[:, 1:-1], rtol=0, atol=0.05)


def test_nothing_seen_and_one_depth_are_pictures_too():
    colors, ends = color_depth(torch.zeros(1, 4, 4))
    assert colors.shape == (3, 4, 4)
    assert ends == (0.0, 0.0)
    assert color_depth(torch.full((1, 4, 4), 3.0))[0].isfinite().all()


@pytest.mark.parametrize(
    ("normal", "color"),
    [
        ([0.0, 0, -1], [0.5, 0.5, 1]),  # faces the camera
        ([1.0, 0, 0], [1, 0.5, 0.5]),  # right
        ([0.0, -1, 0], [0.5, 1, 0.5]),  # up
        ([0.6, 0.0, -0.8], [0.8, 0.5, 0.9]),
        ([0.0, 0, 0], [NOTHING] * 3),
    ],
)
def test_colors_are_those_of_normal_maps(normal, color):
    found = color_normals(torch.tensor(normal)[:, None, None])
    torch.testing.assert_close(found[:, 0, 0], torch.tensor(color))
