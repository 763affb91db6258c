"""Images for people from tensors: bytes, grids, sheets with labels, and colours for depth and normals."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.files import write_bytes
from completesplat.photo.saving import image_bytes, label_font

Maps = Float[Tensor, "*batch 1 height width"]
Colors = Float[Tensor, "*batch 3 height width"]

READABLE_SIDE = 144
GAP = 6
LINE = 20
MARGIN = 12
INK = "black"
PAPER = "white"
NOTHING = 0.5
# From far to near. Lightness rises steadily, so that a greyscale copy shows the same order.
STOPS = [
    [0.05, 0.03, 0.20],
    [0.30, 0.08, 0.45],
    [0.62, 0.18, 0.45],
    [0.90, 0.40, 0.25],
    [0.98, 0.70, 0.20],
    [1.00, 0.98, 0.70],
]


def to_pixels(images: Colors) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Convert images (sRGB, clamped to [0, 1]) to bytes, channels last.

    Raises:
        ValueError: a value is not finite.
    """
    if not images.isfinite().all():
        raise ValueError("images hold values that are not finite")
    scaled = images.detach().clamp(0, 1).mul(255).round().to(torch.uint8)
    return scaled.movedim(-3, -1).cpu().numpy()


def write_png(path: Path, image: Image.Image) -> None:
    write_bytes(path, image_bytes(image, "PNG"))


def enlarge(
    images: Float[Tensor, "*batch channel height width"], factor: int
) -> Float[Tensor, "*batch channel tall wide"]:
    """Enlarge images by repeating every pixel `factor` times in both directions, without interpolation."""
    return images.repeat_interleave(factor, dim=-2).repeat_interleave(factor, dim=-1)


def image_grid(*rows: Float[Tensor, "_ 3 height width"], factor: int = 3) -> Image.Image:
    """Return enlarged rows of images (sRGB, 0 to 1) of one size, with white at the end of short rows."""
    columns = max(len(row) for row in rows)
    filled = []
    for row in rows:
        white = row.new_ones(columns - len(row), *row.shape[1:])
        filled.append(torch.cat([row, white]))
    whole = rearrange(torch.stack(filled), "row column rgb height width -> rgb (row height) (column width)")
    return Image.fromarray(to_pixels(enlarge(whole, factor)))


@dataclass(frozen=True)
class SheetCell:
    """An image (sRGB, 0 to 1) on a sheet, and the label above it."""

    image: Float[Tensor, "3 height width"]
    label: str = ""


Sheet = list[list[SheetCell | None]]  # rows of a sheet


def strip(images: Float[Tensor, "_ 3 height width"], label: str = "", width: int = 0) -> list[SheetCell | None]:
    """Return images side by side on a sheet, a label above the first, and empty cells up to `width`."""
    cells: list[SheetCell | None] = []
    for index, image in enumerate(images):
        cells.append(SheetCell(image, label if index == 0 else ""))
    return cells + [None] * (width - len(cells))


def image_sheet(headings: Sequence[str] | None, rows: Sheet, title: str | None = None) -> Image.Image:
    """Return images in rows and columns, each enlarged by a whole factor to about 144 px, with its label above it.

    Args:
        headings: headings of the columns, if any.
        rows: at least one, none longer than `headings`; None leaves a cell empty. All images have the same size.
        title: the first line; None leaves no space for it.
    """
    if headings is None:
        headings = [""] * max(map(len, rows))
    first = next(cell.image for row in rows for cell in row if cell is not None)
    factor = max(1, round(READABLE_SIDE / max(first.shape[-2:])))
    height = first.shape[-2] * factor
    width = first.shape[-1] * factor
    heading_top = MARGIN + (0.0 if title is None else 1.5 * LINE)
    lefts = [MARGIN + column * (width + GAP) for column in range(len(headings) + 1)]
    tops = [int(heading_top) + 2 * LINE + row * (height + LINE + GAP) for row in range(len(rows) + 1)]
    sheet = Image.new("RGB", (lefts[-1] - GAP + MARGIN, tops[-1] - LINE - GAP + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = label_font(12)
    if title is not None:
        draw.text((MARGIN, MARGIN), title, INK, label_font(15))
    for heading, left in zip(headings, lefts, strict=False):
        draw.text((left, heading_top), heading, INK, font)
    for row, top in zip(rows, tops, strict=False):
        for cell, left in zip(row, lefts, strict=False):
            if cell is not None:
                draw.text((left, top - LINE), cell.label, INK, font)
                pixels = to_pixels(enlarge(cell.image, factor))
                sheet.paste(Image.fromarray(np.ascontiguousarray(pixels)), (left, top))
    return sheet


def color_depth(depth: Maps) -> tuple[Colors, tuple[float, float]]:
    """Colour depths linearly in inverse depth, near bright and far dark, on one scale for all images.

    The scale ignores the nearest and the farthest 2 % of the pixels, so that stray Gaussians do not compress the rest.
    Pixels whose depth is not finite or not above 0 are grey, because no surface is seen there.

    Returns:
        The images, and the near and far depths at the ends of the scale (0, 0 if no surface is seen at all).
    """
    surface = depth.isfinite() & (depth > 0)
    if not surface.any():
        grey = torch.full_like(depth, NOTHING).expand(*depth.shape[:-3], 3, *depth.shape[-2:])
        return grey, (0.0, 0.0)
    ordered = depth[surface].sort().values
    stray = len(ordered) // 50
    near = ordered[stray]
    far = ordered[-1 - stray]
    inverse = 1 / torch.where(surface, depth, far)
    span = (1 / near - 1 / far).clamp(min=1e-12)
    colors = ramp((inverse - 1 / far) / span)
    return torch.where(surface, colors, NOTHING), (near.item(), far.item())


def ramp(values: Maps) -> Colors:
    """Return colours for values from 0 (dark) to 1 (bright), to which other values are clamped."""
    position = values.clamp(0, 1) * (len(STOPS) - 1)
    stops = torch.tensor(STOPS, dtype=values.dtype, device=values.device)
    lower = position.floor().clamp(max=len(STOPS) - 2)
    index = lower.long().squeeze(-3)
    mix = (position - lower).squeeze(-3)[..., None]
    return torch.lerp(stops[index], stops[index + 1], mix).movedim(-1, -3)


def color_normals(normals: Colors) -> Colors:
    """Return (n + 1) / 2 of unit normals in the camera's frame, with the axes of normal maps: right, up, to the viewer.

    Surfaces that face the camera are light blue (0.5, 0.5, 1), those that face right red, those that face up green. In
    the camera's own axes (+y down, +z forward), the colour is (1 + x, 1 - y, 1 - z) / 2. A normal of 0 (none) is grey.
    """
    signs = torch.tensor([1.0, -1.0, -1.0], dtype=normals.dtype, device=normals.device)
    return (normals * signs[:, None, None] + 1) / 2
