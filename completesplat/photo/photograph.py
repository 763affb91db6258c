"""The door to one photo: everything that a model is to know of it, in one function."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from completesplat.photo.crop import part_within
from completesplat.photo.reading import ALL, Framing, ImageLike, Photograph, read_square
from completesplat.photo.visible import visible_part
from completesplat.photo.warnings import photo_warnings
from completesplat.quantities import Crop
from completesplat.wording import printable

logger = logging.getLogger(__name__)


def read_photograph(
    source: ImageLike,
    framing: Framing,
    fov_degrees: float | None = None,
    remove_background: bool = False,
    mask: ImageLike | None = None,
    box: Sequence[float] | None = None,
    crop: Crop = "whole",
) -> Photograph:
    """Read a photo as the training images of a model were framed, and log how, with warnings if it is unlike them.

    Args:
        source, fov_degrees, remove_background, crop: as of `read_square`.
        framing: how the model's training images were framed.
        mask, box: the part of the photo that is hidden (`visible_part`).

    Raises:
        ImageError, CompleteSplatError: as `read_square` and `visible_part`.
    """
    photograph = read_square(source, framing, fov_degrees, remove_background, crop)
    photograph = replace(photograph, visible=visible_part(photograph, mask, box))
    if framing.training is not None:
        name = printable(Path(source).name) if isinstance(source, str | Path) else "the image"
        line = framing_line(photograph)
        if line is not None:
            is_asked = crop != "whole" or photograph.cut_out is not None
            logger.log(logging.INFO if is_asked or not is_cut(photograph) else logging.WARNING, "%s: %s", name, line)
        for warning in photo_warnings(photograph, framing.training, framing.fov_degrees):
            logger.warning("%s: %s", name, warning)
    return photograph


def framing_line(photograph: Photograph) -> str | None:
    """Return how a photo became a square, or None if it is one and all of it was taken."""
    words = []
    if is_cut(photograph):
        width, height = photograph.photo_size
        left, top, right, bottom = part_within(photograph.window, photograph.photo_size)
        taken = f"{right - left} x {bottom - top} of its {width} x {height} pixels are taken"
        words.append(f"{taken}, from ({left}, {top})")
    if photograph.part != ALL:
        words.append("its border is continued to a square")
    return "; ".join(words) or None


def is_cut(photograph: Photograph) -> bool:
    """Return whether something of a photo lies outside of its square."""
    return part_within(photograph.window, photograph.photo_size) != (0, 0, *photograph.photo_size)
