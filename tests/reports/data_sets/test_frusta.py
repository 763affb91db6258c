import math

import numpy as np
import pytest
import torch

from completesplat.geometry.cameras import project
from completesplat.studies.frusta import drawings, place_cross, time_color

SIDE = 200


def drawn(sequence):
    return drawings(sequence, place_cross(sequence.cameras, sequence.depth_ranges[0]))


def orange(picture):
    """Pixels of the last camera, at (column, row)."""
    red, green, blue = np.moveaxis(np.asarray(picture).astype(int), -1, 0)
    return np.argwhere(((red - blue > 60) & (green - blue > 30)).T)


def black(picture):
    """Pixels of the first camera (the scale bar, at the lower edge, is black too)."""
    dark = np.asarray(picture).max(axis=-1) < 60
    dark[-9:] = False
    return np.argwhere(dark.T)


def lowest(pixels):
    """Middle of the lowest row of pixels."""
    row = pixels[:, 1].max()
    return np.array([pixels[pixels[:, 1] == row][:, 0].mean(), row])


def pixels_per_unit(sequence, picture):
    dark = np.asarray(picture)[-5, : SIDE // 2].max(axis=-1) < 60
    return (np.ptp(np.flatnonzero(dark)) + 1) / drawn(sequence).scale_bar()


def test_cameras_are_drawn_at_their_places_from_above(walk):
    """The second camera is 1 to the right of the first and 2 ahead; frusta open ahead, so apexes are lowest."""
    sequence = walk((0.0, 0.0, 0.0), (1.0, 0.0, 2.0), depth_range=(0.5, 3.0))
    picture = drawn(sequence).from_above(SIDE)
    # The dots of first and others have radii 4 and 2.
    moved = (lowest(orange(picture)) - (0, 2)) - (lowest(black(picture)) - (0, 4))
    unit = pixels_per_unit(sequence, picture)
    assert moved == pytest.approx([unit, -2 * unit], abs=2.5)


def test_cameras_are_drawn_at_their_places_from_the_side(walk):
    """Ahead is to the right, and up (-y here) is up; apexes are leftmost."""
    sequence = walk((0.0, 0.0, 0.0), (0.0, -1.0, 2.0), depth_range=(0.5, 3.0))
    picture = drawn(sequence).from_the_side(SIDE)
    unit = pixels_per_unit(sequence, picture)
    first, last = (lowest(pixels[:, ::-1] * (1, -1)) for pixels in (black(picture), orange(picture)))
    # `lowest` of (row, -column): the row of the leftmost pixels, and the column.
    moved = (last - (0, 2)) - (first - (0, 4))
    assert moved == pytest.approx([-unit, -2 * unit], abs=2.5)


@pytest.mark.parametrize("fov", [40.0, 90.0])
def test_a_frustum_opens_by_its_field_of_view(walk, fov):
    sequence = walk((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), fov=fov, depth_range=(1.0, 2.0))
    pixels = orange(drawn(sequence).from_above(400))
    top, apex = pixels[:, 1].min(), pixels[:, 1].max() - 2
    width = np.ptp(pixels[:, 0])
    assert width / (apex - top) == pytest.approx(2 * math.tan(math.radians(fov / 2)), rel=0.12)


def test_frusta_end_in_the_corners_of_the_pictures(orbit):
    sequence = orbit(5, height=1.0, fov=70.0)
    pixels, depth = project(sequence.cameras, drawn(sequence).frusta[:, 1:5])
    corners = torch.tensor([[0, 0], [24, 0], [24, 24], [0, 24]]).double()
    assert torch.allclose(pixels, corners.expand(5, 4, 2), atol=1e-6)
    assert (depth > 0).all()


def test_the_tick_at_the_upper_edge_tells_which_way_up_a_camera_is(walk):
    """From the side, the last camera's frustum reaches higher above its apex than below it."""
    pixels = orange(drawn(walk((0.0, 0.0, 0.0), (0.0, 0.0, 3.0), depth_range=(1.0, 2.0))).from_the_side(400))
    apex = pixels[pixels[:, 0] == pixels[:, 0].min()][:, 1].mean()
    above, below = apex - pixels[:, 1].min(), pixels[:, 1].max() - apex
    assert above > 1.2 * below


def test_all_cameras_and_the_depth_range_are_inside_of_the_drawing(orbit):
    drawing = drawn(orbit(24, height=1.0))
    for picture in (drawing.from_above(SIDE), drawing.from_the_side(SIDE)):
        border = np.asarray(picture).copy()
        border[3:-9, 3:-3] = 255
        border[-9:, : SIDE // 2] = 255  # the scale bar
        assert (border == 255).all()


def test_the_depth_range_is_drawn_along_the_first_axis(orbit):
    drawing = drawn(orbit(24, radius=2.0, depth_range=(1.0, 3.0)))  # the first camera is at +z
    assert not drawing.cut
    assert np.allclose(drawing.depth_range, [[0, 0, 1], [0, 0, -1]], atol=1e-6)


def test_a_far_plane_far_away_does_not_make_the_cameras_small(orbit):
    drawing = drawn(orbit(24, radius=2.0, depth_range=(1.0, 1000.0)))
    assert drawing.cut
    assert drawing.span < 12


def test_a_depth_range_at_another_scale_is_seen(orbit):
    drawing = drawn(orbit(24, radius=2.0, depth_range=(90.0, 110.0)))
    assert not drawing.cut
    assert drawing.span > 100


def test_a_single_camera_is_drawn(walk):
    assert len(black(drawn(walk((0.0, 0.0, 0.0))).from_above(SIDE))) > 20


def test_colors_grow_brighter_with_time():
    brightness = [sum(time_color(share)) for share in np.linspace(0, 1, 9)]
    assert brightness == sorted(brightness)
    assert len(set(brightness)) == 9
