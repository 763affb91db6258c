import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.export.prediction import Row, contact_sheet


def occurrences(sheet, image):
    """Upper left corners (row, column) where the image lies in the sheet, pixel for pixel."""
    windows = np.lib.stride_tricks.sliding_window_view(sheet[..., :3], image.shape)[:, :, 0]
    candidates = np.argwhere(
        (windows[:, :, 0, 0] == image[0, 0]).all(-1) & (windows[:, :, -1, -1] == image[-1, -1]).all(-1)
    )
    return [tuple(c) for c in candidates.tolist() if (windows[tuple(c)] == image).all()]


def as_pixels(image, factor):
    pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
    return pixels.repeat(factor, axis=0).repeat(factor, axis=1)


@pytest.fixture
def rows():
    generator = torch.Generator().manual_seed(0)
    return [
        Row(
            f"sample {i}", torch.rand(8, 3, 36, 48, generator=generator), torch.rand(1, 36, 48, generator=generator) + 1
        )
        for i in range(3)
    ]


def test_every_image_stands_upright_in_its_row_and_column(tmp_path, rows):
    reference = torch.rand(3, 36, 48)
    contact_sheet(tmp_path / "a.png", "title", reference, rows, [45.0 * i for i in range(8)])
    sheet = np.asarray(Image.open(tmp_path / "a.png"))
    (corner,) = occurrences(sheet, as_pixels(reference, 3))
    corners = np.array([[occurrences(sheet, as_pixels(image, 3))[0] for image in row.images] for row in rows])
    assert corners.shape == (3, 8, 2)
    assert (corners[:, :, 0] == corners[:, :1, 0]).all()
    assert (corners[:, :, 1] == corners[:1, :, 1]).all()
    assert (np.diff(corners[:, 0, 0]) > 36 * 3).all()
    assert (np.diff([corner[1], *corners[0, :, 1]]) > 48 * 3).all()
    assert corner[0] == corners[0, 0, 0]
    # Depth is the last column, and nothing is cut off at the right or below.
    assert sheet.shape[1] > corners[0, -1, 1] + 2 * 48 * 3
    assert sheet.shape[0] >= corners[-1, 0, 0] + 36 * 3


def test_title_and_labels_are_drawn(tmp_path, rows):
    contact_sheet(tmp_path / "a.png", "a title", torch.ones(3, 36, 48), rows[:1], [0.0] * 8)
    contact_sheet(tmp_path / "b.png", "", torch.ones(3, 36, 48), rows[:1], [0.0] * 8)
    first, second = (np.asarray(Image.open(tmp_path / name)).astype(int) for name in ("a.png", "b.png"))
    changed = np.argwhere(np.abs(first - second).sum(-1) > 0)
    assert len(changed) > 0
    assert changed[:, 0].max() < 40


def test_views_without_an_angle_are_refused(tmp_path, rows):
    with pytest.raises(ValueError, match="angles"):
        contact_sheet(tmp_path / "a.png", "", torch.ones(3, 36, 48), rows, [0.0] * 7)
