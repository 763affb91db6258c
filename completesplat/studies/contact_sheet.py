"""Contact sheet of several sequences and their cameras, on which a wrong convention is obvious."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.errors import DataError
from completesplat.export.images import GAP, INK, LINE, MARGIN, PAPER, write_png
from completesplat.studies.frusta import CROSS_COLORS, NEAREST, Cross, drawings, place_cross, visible_segments

CELL, TEXT, NAME, TITLE = 216, 13, 15, 18
GREY, MASK = (190, 190, 190), (255, 220, 0)
DRAWINGS = ("from above", "from the side")
LEGEND = (
    "Pictures: one cross stands at one place of each scene and must stick to it, its square level as a floor; "
    "red: to the first camera's right, green: up, blue: ahead; yellow: mask.",
    "Cameras: black: the first, then dark blue to orange with time; the tick is the picture's upper edge; "
    "grey bar: near to far of the first (an arrow: farther); right, up and ahead are the first camera's.",
)


def show(sequences: Sequence[PosedSequence], path: Path, pictures: int, title: str) -> None:
    """Write a PNG with a row for each sequence: some images, and its cameras from above and from the side.

    The images are evenly spaced from the first to the last frame. An unreadable image becomes a grey cell with the
    kind of its `DataError`.
    """
    width = _left(pictures + len(DRAWINGS)) - GAP + MARGIN
    legend = [line for text in LEGEND for line in _wrapped(text, width - 2 * MARGIN)]
    top = MARGIN + int(1.5 * LINE)
    header = top + len(legend) * LINE
    row_height = 2 * LINE + CELL + GAP
    sheet = Image.new("RGB", (width, header + len(sequences) * row_height + MARGIN), PAPER)
    _text(sheet, (MARGIN, MARGIN), title, width - 2 * MARGIN, TITLE)
    for index, line in enumerate(legend):
        _text(sheet, (MARGIN, top + index * LINE), line, width - 2 * MARGIN)
    for index, sequence in enumerate(sequences):
        _draw_row(sheet, header + index * row_height, sequence, pictures)
    write_png(path, sheet)


def _draw_row(sheet: Image.Image, top: int, sequence: PosedSequence, pictures: int) -> None:
    """Draw a heading, and cells with captions below them."""
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    (near, far), (focal, *_) = sequence.depth_ranges[0].tolist(), sequence.cameras.intrinsics[0, 0].tolist()
    fov = math.degrees(2 * math.atan(sequence.cameras.image_size[1] / 2 / focal))
    numbers = f"{len(sequence.frames)} cameras, field of view {fov:.1f}°, near {near:.3g}, far {far:.3g}"
    _text(sheet, (MARGIN, top), f"{sequence.name}: {numbers}", sheet.width - 2 * MARGIN, NAME)
    chosen = np.unique(np.linspace(0, len(sequence.frames) - 1, pictures).round().astype(int)).tolist()
    cells = {}
    for column, index in enumerate(chosen):
        cell, where = _picture_cell(sequence, index, cross)
        cells[column] = cell, f"frame {sequence.frames[index]}{where}"
    drawn = drawings(sequence, cross)
    for column, cell in enumerate((drawn.from_above(CELL), drawn.from_the_side(CELL))):
        cells[pictures + column] = cell, f"{DRAWINGS[column]}, bar: {drawn.scale_bar():g}"
    for column, (cell, caption) in cells.items():
        sheet.paste(cell, (_left(column), top + LINE))
        _text(sheet, (_left(column), top + LINE + CELL), caption, CELL)


def _picture_cell(sequence: PosedSequence, index: int, cross: Cross) -> tuple[Image.Image, str]:
    """Return an image with the cross, and a remark if the cross is not in the image."""
    try:
        picture = sequence.read(index)
    except DataError as error:
        cell = Image.new("RGB", (CELL, CELL), GREY)
        for number, line in enumerate(_wrapped(error.kind, CELL - 2 * GAP)):
            _text(cell, (GAP, CELL // 2 - LINE + number * LINE), line, CELL - 2 * GAP)
        return cell, ""
    cell = _with_outline(picture)
    camera, draw = sequence.cameras[index], ImageDraw.Draw(cell)
    nearest = NEAREST * cross.arms.norm(dim=-1)[0].item()
    sides, arms = (visible_segments(camera, segments, nearest) for segments in (cross.square(), cross.ends()))
    lines = [(ends, "white", 2) for _, ends in sides] + [(ends, CROSS_COLORS[arm], 3) for arm, ends in arms]
    for ends, color, width in lines:
        points = [(x, y) for x, y in (CELL / camera.image_size[1] * ends).tolist()]
        draw.line(points, INK, width + 2)  # a dark edge keeps it visible on any image
        draw.line(points, color, width)
    inside = any(((ends > 0) & (ends < camera.image_size[1])).all(dim=-1).any() for _, ends in arms)
    return cell, "" if inside else ": cross outside" if arms else ": cross behind"


def _with_outline(picture: MaskedImage) -> Image.Image:
    """Resize an image to a cell, with a line where the mask crosses one half."""
    image = Image.fromarray(np.ascontiguousarray(picture.image.permute(1, 2, 0).numpy()))
    # This filter repeats pixels to enlarge an image, and averages them to reduce it.
    pixels = np.array(image.resize((CELL, CELL), Image.Resampling.BOX))
    if picture.mask is not None:
        mask = Image.fromarray(np.ascontiguousarray(picture.mask[0].numpy()))
        inside = np.array(mask.resize((CELL, CELL), Image.Resampling.BOX)) >= 128
        padded = np.pad(inside, 1, mode="edge")
        neighbors = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        pixels[inside & ~neighbors] = MASK
    return Image.fromarray(pixels)


def _left(column: int) -> int:
    return MARGIN + column * (CELL + GAP)


def _text(picture: Image.Image, place: tuple[int, int], text: str, width: int, size: int = TEXT) -> None:
    """Write one line, shortened to `width` pixels."""
    font = ImageFont.load_default(size=size)
    line, text = text, text.rstrip()
    while line and font.getlength(line) > width:
        text = text[:-1]
        line = f"{text}..."
    ImageDraw.Draw(picture).text(place, line, INK, font)


def _wrapped(text: str, width: int) -> list[str]:
    """Break a text into lines that fit into `width` pixels."""
    font = ImageFont.load_default(size=TEXT)
    wrapped = (textwrap.wrap(text, columns) for columns in range(len(text), 0, -1))
    return next(lines for lines in wrapped if all(font.getlength(line) <= width for line in lines))
