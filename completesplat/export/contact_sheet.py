"""One picture that shows an input image and what several samples made of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.depth_colors import color_depth
from completesplat.export.pixels import enlarge, to_bytes

READABLE_SIDE = 144
GAP, LINE, MARGIN = 6, 20, 12
INK, PAPER = "black", "white"


@dataclass(frozen=True)
class Row:
    """One sample: its renderings from several directions, and the depth seen from the first of them."""

    label: str
    images: Float[Tensor, "view 3 height width"]
    depth: Float[Tensor, "1 height width"]


def contact_sheet(
    path: str | Path,
    title: str,
    reference: Float[Tensor, "3 height width"],
    rows: Sequence[Row],
    angles: Sequence[float],
) -> None:
    """Write a PNG: the input image in the first column, then a row for each sample with its views and its depth.

    All images share one size and are enlarged by a whole factor to cells of about 144 px. Depth is coloured on one
    scale for all rows (near bright, far dark); places that show nothing are grey.

    Args:
        path: the file.
        title: its first line.
        reference: the input image.
        rows: the samples, at least one.
        angles: of the views in degrees, the same for all rows.

    Raises:
        ValueError: images that are not finite, or numbers of views and angles that differ.
    """
    if any(len(row.images) != len(angles) for row in rows):
        raise ValueError(f"{len(angles)} angles given for rows of {[len(row.images) for row in rows]} views")
    factor = max(1, round(READABLE_SIDE / max(reference.shape[-2:])))
    height, width = (side * factor for side in reference.shape[-2:])
    sheet = Image.new("RGB", _sheet_size(height, width, len(rows), len(angles) + 2), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=13)
    depth_pictures, (near, far) = color_depth(torch.stack([row.depth for row in rows]))

    draw.text((MARGIN, MARGIN), title, INK, ImageFont.load_default(size=16))
    headings = ["input", *(f"{angle:g}°" for angle in angles), f"depth {near:.3g} to {far:.3g}"]
    for column, heading in enumerate(headings):
        draw.text((_left(column, width), MARGIN + 1.5 * LINE), heading, INK, font)
    for index, (row, depth_picture) in enumerate(zip(rows, depth_pictures, strict=True)):
        top = _top(index, height)
        draw.text((_left(1, width), top - LINE), row.label, INK, font)
        cells = [*row.images, depth_picture]
        if index == 0:
            _paste(sheet, reference, factor, _left(0, width), top)
        for column, cell in enumerate(cells, start=1):
            _paste(sheet, cell, factor, _left(column, width), top)
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="PNG")


def _sheet_size(height: int, width: int, rows: int, columns: int) -> tuple[int, int]:
    return _left(columns, width) - GAP + MARGIN, _top(rows, height) - LINE - GAP + MARGIN


def _left(column: int, width: int) -> int:
    return MARGIN + column * (width + GAP)


def _top(row: int, height: int) -> int:
    """Upper edge of a row's cells; above it stands its label, above the first row also the title and headings."""
    return MARGIN + int(2.5 * LINE) + LINE + row * (height + LINE + GAP)


def _paste(sheet: Image.Image, image: Float[Tensor, "3 height width"], factor: int, left: int, top: int) -> None:
    sheet.paste(Image.fromarray(np.ascontiguousarray(to_bytes(enlarge(image, factor)))), (left, top))
