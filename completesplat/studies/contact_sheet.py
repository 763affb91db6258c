"""Contact sheet of several sequences and their cameras, on which a wrong convention is obvious."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from completesplat.data.sequences import Picture, PosedSequence
from completesplat.errors import DataError
from completesplat.export.images import INK, MARGIN, PAPER, SheetCell, image_sheet, write_png
from completesplat.studies.frusta import CROSS_COLORS, NEAREST, Cross, drawings, place_cross, visible_segments

CELL = 216
GREY, MASK = (190, 190, 190), (255, 220, 0)
LEGEND = """Images: one cross stands at one place of each scene and must stick to it;
red: to the first camera's right, green: up, blue: ahead; yellow: mask.
Cameras: black: the first, then dark blue to orange with time; the tick is the image's upper edge;
grey bar: near to far of the first (without a tick: farther); right, up and ahead are the first camera's."""


def show(sequences: Sequence[PosedSequence], path: Path, images: int, title: str) -> None:
    """Write a PNG with a row for each sequence: some images, and its cameras from above and from the side.

    The images are evenly spaced from the first to the last frame. An unreadable image becomes a grey cell with the
    kind of its `DataError`.
    """
    rows = [_row(sequence, images) for sequence in sequences]
    header = Image.new("RGB", (rows[0].width, MARGIN + 100), PAPER)
    ImageDraw.Draw(header).text((MARGIN, MARGIN), f"{title}\n{LEGEND}", INK, ImageFont.load_default(size=13))
    write_png(path, Image.fromarray(np.concatenate([np.asarray(part) for part in (header, *rows)])))


def _row(sequence: PosedSequence, images: int) -> Image.Image:
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    chosen = np.unique(np.linspace(0, len(sequence.frames) - 1, images).round().astype(int)).tolist()
    cells: list[SheetCell | None] = [_image_cell(sequence, index, cross) for index in chosen]
    cells += [None] * (images - len(chosen))
    cells += [SheetCell(_tensor(image), view) for view, image in drawings(sequence, cross, CELL).items()]
    (near, far), (focal, *_) = sequence.depth_ranges[0].tolist(), sequence.cameras.intrinsics[0, 0].tolist()
    fov = math.degrees(2 * math.atan(sequence.cameras.image_size[1] / 2 / focal))
    numbers = f"{len(sequence.frames)} cameras, field of view {fov:.1f}°, near {near:.3g}, far {far:.3g}"
    return image_sheet([f"{sequence.name}: {numbers}", *[""] * (images + 1)], [cells])


def _image_cell(sequence: PosedSequence, index: int, cross: Cross) -> SheetCell:
    """Return an image with the cross; the label states if the cross is not in the image."""
    label = f"frame {sequence.frames[index]}"
    try:
        picture = sequence.read(index)
    except DataError as error:
        cell = Image.new("RGB", (CELL, CELL), GREY)
        ImageDraw.Draw(cell).text((MARGIN, CELL // 2), error.kind, INK, ImageFont.load_default(size=13))
        return SheetCell(_tensor(cell), label)
    cell = _with_outline(picture)
    camera, draw = sequence.cameras[index], ImageDraw.Draw(cell)
    nearest = NEAREST * cross.arms.norm(dim=-1)[0].item()
    arms = visible_segments(camera, cross.ends(), nearest)
    for arm, ends in arms:
        points = [(x, y) for x, y in (CELL / camera.image_size[1] * ends).tolist()]
        draw.line(points, INK, 5)  # a dark edge keeps it visible on any image
        draw.line(points, CROSS_COLORS[arm], 3)
    inside = any(((ends > 0) & (ends < camera.image_size[1])).all(dim=-1).any() for _, ends in arms)
    return SheetCell(_tensor(cell), label + ("" if inside else ": cross outside" if arms else ": cross behind"))


def _with_outline(picture: Picture) -> Image.Image:
    """Resize an image to a cell, with a line where the mask crosses one half."""
    pixels = _resized(picture.image.permute(1, 2, 0).numpy()).copy()
    if picture.mask is not None:
        inside = _resized(picture.mask[0].numpy()) >= 128
        padded = np.pad(inside, 1, mode="edge")
        neighbors = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        pixels[inside & ~neighbors] = MASK
    return Image.fromarray(pixels)


def _resized(pixels: UInt8[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Repeat pixels to enlarge an image to a cell, and average them to reduce it."""
    return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize((CELL, CELL), Image.Resampling.BOX))


def _tensor(image: Image.Image | UInt8[np.ndarray, "height width 3"]) -> Float[Tensor, "3 height width"]:
    return torch.from_numpy(np.array(image)).movedim(-1, 0) / 255
