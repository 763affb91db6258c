import numpy as np
import torch
from PIL import Image

from completesplat.data.sequences import MaskedImage
from completesplat.data.validation import BadImage, OutsidePath
from completesplat.export.images import GAP, MARGIN
from completesplat.geometry.cameras import project
from completesplat.studies.contact_sheet import CELL, CROSS_COLORS, MASK, place_cross, write_contact_sheet

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
