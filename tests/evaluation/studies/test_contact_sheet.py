"""Contact sheets, and the cross in them that stands at one place of a scene."""

import math

import numpy as np
import torch
from PIL import Image

from completesplat.data.sequences import MaskedImage
from completesplat.errors import BadImage, OutsidePath
from completesplat.evaluation.studies.contact_sheet import (
    CELL,
    CROSS_COLORS,
    MASK,
    level_axes,
    place_cross,
    visible_segments,
    write_contact_sheet,
)
from completesplat.export.images import GAP, MARGIN
from completesplat.geometry.cameras import Cameras, pinhole, project

SIZE = 24


def sheet_of(sequences, path, images=3, title="title"):
    write_contact_sheet(sequences, path / "show.png", images, title)
    return np.asarray(Image.open(path / "show.png").convert("RGB"))


def cells(sheet, sequences, images):
    """Return the cells [sequence image CELL CELL 3]; each starts at the first pixel row whose ends are not white."""
    lefts = [MARGIN + column * (CELL + GAP) for column in range(images)]
    filled = (sheet[:, lefts[0]] != 255).any(-1) & (sheet[:, lefts[0] + CELL - 1] != 255).any(-1)
    tops = [row for row in range(1, len(sheet)) if filled[row : row + CELL].sum() == CELL and not filled[row - 1]]
    assert len(tops) == sequences
    return np.stack([[sheet[top : top + CELL, left : left + CELL] for left in lefts] for top in tops])


def test_images_are_evenly_spaced_in_time(orbit, tmp_path):
    sequence = orbit(24, read=lambda i: MaskedImage(torch.full((3, SIZE, SIZE), 10 * i, dtype=torch.uint8), None))
    shown = cells(sheet_of([sequence], tmp_path, 6), 1, 6)[0]
    indices = [int(cell[0, 0, 0]) // 10 for cell in shown]
    assert (indices[0], indices[-1]) == (0, 23)
    assert set(np.diff(indices)) <= {4, 5}


def test_an_image_is_shown_upright_and_unmirrored_with_the_outline_of_its_mask(orbit, tmp_path):
    image, mask = (torch.rand(3, SIZE, SIZE) * 255).byte(), torch.zeros(1, SIZE, SIZE, dtype=torch.uint8)
    mask[:, :, : SIZE // 4], mask[:, :, SIZE // 4 : SIZE // 3] = 255, 100  # on either side of one half
    shown = cells(sheet_of([orbit(1, read=lambda i: MaskedImage(image, mask))], tmp_path, 1), 1, 1)[0, 0]
    yellow = (shown == MASK).all(-1)
    assert set(np.flatnonzero(yellow.any(0))) == {CELL // 4 - 1}
    assert yellow[:, CELL // 4 - 1].mean() > 0.9
    large = image.permute(1, 2, 0).numpy().repeat(CELL // SIZE, axis=0).repeat(CELL // SIZE, axis=1)
    for rows in (slice(None, 40), slice(-40, None)):  # above and below the cross
        assert ((shown == large).all(-1) | yellow)[rows].all()


def test_the_cross_is_drawn_where_it_projects_and_not_behind_the_camera(orbit, walk, tmp_path):
    sequence = orbit(12, height=1.2, center=(0.3, 0.2, -0.4), turn=75.0)
    shown = cells(sheet_of([sequence], tmp_path, 12), 1, 12)[0]
    ends = place_cross(sequence.cameras, sequence.depth_ranges[0]).ends()
    pixels = project(sequence.cameras, ends.flatten(0, 1))[0].unflatten(1, (3, 2)) * CELL / SIZE
    for cell, arms in zip(shown, pixels.numpy(), strict=True):
        rows, columns = np.nonzero((cell == CROSS_COLORS[1]).all(-1))
        (left, top), (right, bottom) = arms[1].min(axis=0) - 4, arms[1].max(axis=0) + 4
        assert left < columns.min() <= columns.max() < right
        assert top < rows.min() <= rows.max() < bottom
        # Other arms may hide the foot of an arm, but the tips of all arms are visible.
        for color, (_, (x, y)) in zip(CROSS_COLORS, arms, strict=True):
            near = cell[max(0, int(y) - 4) : int(y) + 5, max(0, int(x) - 4) : int(x) + 5]
            assert (near == color).all(-1).any()
    sequence = walk((0.0, 0.0, 0.0), (50.0, 0.0, 9.0), depth_range=(1.0, 2.0))
    first, second = cells(sheet_of([sequence], tmp_path, 2), 1, 2)[0]
    assert (first == CROSS_COLORS[1]).all(-1).any()
    assert (second == 120).all()


def test_a_refused_image_is_a_grey_cell_with_the_reason(orbit, tmp_path):
    def read(index):
        if index in (1, 2):
            raise (BadImage if index == 1 else OutsidePath)("this one", "file.jpg")
        return MaskedImage(torch.full((3, SIZE, SIZE), 120, dtype=torch.uint8), None)

    shown = cells(sheet_of([orbit(4, read=read)], tmp_path, 4), 1, 4)[0]
    for cell in shown[1:3]:
        assert (cell[0, 0] == cell[-1, -1]).all()
        text = (cell != cell[0, 0]).any(-1)
        assert 20 < text.sum() < 0.1 * CELL**2
        assert not text[:, [0, 1, 2, -3, -2, -1]].any()
    assert (shown[1] != shown[2]).any()
    assert all((cell == CROSS_COLORS[1]).all(-1).any() for cell in shown[[0, 3]])


def close(first, second, tolerance=1e-9):
    return torch.allclose(first, torch.tensor(second, dtype=first.dtype), atol=tolerance)


def crossed(sequence):
    return place_cross(sequence.cameras, sequence.depth_ranges[0])


def test_the_cross_stands_where_the_cameras_look_or_in_the_middle_of_the_depth_range_ahead(orbit, walk):
    assert close(crossed(orbit(12, height=1.5, center=(3.0, -1.0, 2.0))).center, [3.0, -1.0, 2.0])
    ahead = walk(*[(0.0, 0.0, 0.05 * i) for i in range(5)], depth_range=(1.0, 3.0))
    assert close(crossed(ahead).center, [0, 0, 0.1 + 2 / (1 + 1 / 3)], 1e-5)


def test_inverted_poses_do_not_hold_the_cross_in_its_place(orbit):
    sequence = orbit(12, height=1.0, center=(0.5, 0.0, 0.5))
    inverted = Cameras(sequence.cameras.camera_to_world, sequence.cameras.intrinsics, sequence.cameras.image_size)
    away = {}
    for name, cameras in (("right", sequence.cameras), ("inverted", inverted)):
        pixels, depth = project(cameras, place_cross(cameras, sequence.depth_ranges[0]).center[None])
        away[name] = ((pixels[:, 0] - 12).norm(dim=-1) > 3) | (depth[:, 0] < 0)
    assert away["right"].sum() == 0
    assert away["inverted"].sum() > 6


def test_arms_have_the_angular_size_that_is_documented(orbit):
    cross = crossed(orbit(12, radius=5.0, fov=40.0))
    expected = 0.3 * 5.0 * math.tan(math.radians(20))
    assert close(cross.arms.norm(dim=-1), [expected] * 3, 1e-5)
    for few in map(crossed, (orbit(1), orbit(2))):
        assert few.center.isfinite().all()
        assert few.arms.isfinite().all()


def test_up_is_the_axis_of_an_orbit_or_the_cameras_own(orbit, walk):
    assert close(level_axes(orbit(12, height=1.5).cameras), [[1, 0, 0], [0, 1, 0], [0, 0, -1]])  # from +z, down
    assert close(level_axes(walk((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).cameras), [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    cameras = orbit(12).cameras
    poses = cameras.world_to_camera.clone()
    # The first one sees -y: ahead is at its upper edge, at -z.
    poses[0] = torch.block_diag(torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), torch.ones(1, 1))
    axes = level_axes(Cameras(poses, cameras.intrinsics, cameras.image_size))
    assert close(axes, [[1, 0, 0], [0, 1, 0], [0, 0, -1]])


def test_segments_are_cut_off_before_the_camera():
    camera = Cameras(torch.eye(4), pinhole(90.0, 10), (10, 10))  # focal length 5
    far, behind = [1.0, 0, 1], [0.0, 0, -1]
    segments = torch.tensor([[behind, far], [far, behind], [behind, [0, 0, 0]], [[0, 1, 2], [1, 1, 2]]])
    result = dict(visible_segments(camera, segments, nearest=0.5))
    assert sorted(result) == [0, 1, 3]
    # At depth 0.5 the first one has x = 0.75.
    assert close(result[0], [[12.5, 5], [10, 5]], 1e-5)
    assert close(result[1], [[10, 5], [12.5, 5]], 1e-5)
    assert close(result[3], [[5, 7.5], [7.5, 7.5]], 1e-5)
