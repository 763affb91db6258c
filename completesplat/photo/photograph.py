"""The door to one photo: everything that a model is to know of it, in one function."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from completesplat.photo.reading import Framing, ImageLike, Photograph, read_square
from completesplat.photo.visible import visible_part
from completesplat.photo.warnings import photo_warnings
from completesplat.wording import printable

logger = logging.getLogger(__name__)


def read_photograph(
    source: ImageLike,
    framing: Framing,
    fov_degrees: float | None = None,
    remove_background: bool = False,
    mask: ImageLike | None = None,
    box: Sequence[float] | None = None,
) -> Photograph:
    """Read a photo as the training images of a model were framed, and log warnings if it is unlike them.

    Args:
        source, fov_degrees, remove_background: as of `read_square`.
        framing: how the model's training images were framed.
        mask, box: the part of the photo that is hidden (`visible_part`).

    Raises:
        ImageError, CompleteSplatError: as `read_square` and `visible_part`.
    """
    photograph = read_square(source, framing, fov_degrees, remove_background)
    photograph = replace(photograph, visible=visible_part(photograph, mask, box))
    if framing.training is not None:
        name = printable(Path(source).name) if isinstance(source, str | Path) else "the image"
        for warning in photo_warnings(photograph, framing.training, framing.fov_degrees):
            logger.warning("%s: %s", name, warning)
    return photograph
