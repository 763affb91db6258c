"""Reader of the images on an untitled sheet of `completesplat.export.images`, at their original size."""

import numpy as np
import torch
from PIL import Image

MARGIN, LINE, GAP, READABLE_SIDE = 12, 20, 6, 144


def cells(sheet: Image.Image, height: int, width: int) -> torch.Tensor:
    """Return [row column 3 height width] in [0, 1]; check that the sheet shows each pixel as a square of one colour."""
    factor = round(READABLE_SIDE / max(height, width))
    tall, wide = height * factor, width * factor
    pixels = np.asarray(sheet)[MARGIN + LINE : GAP - MARGIN or None, MARGIN : GAP - MARGIN or None]
    rows, columns = pixels.shape[0] // (LINE + tall + GAP), pixels.shape[1] // (wide + GAP)
    assert pixels.shape == (rows * (LINE + tall + GAP), columns * (wide + GAP), 3)
    grid = pixels.reshape(rows, LINE + tall + GAP, columns, wide + GAP, 3)[:, LINE:-GAP, :, :-GAP]
    squares = grid.reshape(rows, height, factor, columns, width, factor, 3)
    small = squares[:, :, :1, :, :, :1]
    assert (squares == small).all()
    return torch.from_numpy(small[:, :, 0, :, :, 0] / np.float32(255)).permute(0, 2, 4, 1, 3)
