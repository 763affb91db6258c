import pytest
import torch

from completesplat.export.pictures import NOTHING, color_normals


@pytest.mark.parametrize(
    ("normal", "color"),
    [
        ([0.0, 0, -1], [0.5, 0.5, 1]),  # faces the camera
        ([1.0, 0, 0], [1, 0.5, 0.5]),  # right
        ([0.0, -1, 0], [0.5, 1, 0.5]),  # up
        ([0.6, 0.0, -0.8], [0.8, 0.5, 0.9]),
    ],
)
def test_colors_are_those_of_normal_maps(normal, color):
    found = color_normals(torch.tensor(normal)[:, None, None])
    torch.testing.assert_close(found[:, 0, 0], torch.tensor(color))


def test_no_normal_is_as_grey_as_no_depth():
    assert (color_normals(torch.zeros(2, 3, 4, 4)) == NOTHING).all()
