"""One scene in all the file formats that are wanted."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from completesplat.errors import CompleteSplatError
from completesplat.export.page import PageView, write_page
from completesplat.export.ply import write_ply
from completesplat.export.splat import write_splat
from completesplat.export.splat_transform import SplatTransform
from completesplat.gaussians import Gaussians

FORMATS = ("ply", "splat", "spz", "sog", "html")
CONVERTED = ("spz", "sog", "html")


def write_formats(
    folder: Path,
    name: str,
    gaussians: Gaussians,
    formats: Sequence[str],
    view: PageView,
    converter: SplatTransform | None,
    comments: Sequence[str] = (),
) -> dict[str, str]:
    """Write `NAME.ply`, `NAME.spz` and so on.

    All hold the Gaussians in the frame they are given in, save the page, which stands upright. `.ply`, `.splat` and
    `.sog` keep our axes (+y down); `.spz` has +y up and +z towards the viewer, as its format prescribes, which its
    readers undo.

    Args:
        view: how the page begins.
        converter: needed for `CONVERTED` formats.
        comments: for the header of the `.ply`.

    Returns:
        The files' names by purpose: `NAME` for the `.ply`, `NAME_spz` and so on for the others.

    Raises:
        CompleteSplatError: nothing to write, or the converter is missing or fails.
    """
    if converter is None and set(formats) & set(CONVERTED):
        raise CompleteSplatError(f"a converter is needed for {', '.join(set(formats) & set(CONVERTED))}")
    with tempfile.TemporaryDirectory() as temporary:
        source = (folder if "ply" in formats else Path(temporary)) / f"{name}.ply"
        write_ply(source, gaussians, comments)
        for kind in formats:
            target = folder / f"{name}.{kind}"
            if kind == "splat":
                write_splat(target, gaussians)
            elif kind == "html" and converter is not None:
                write_page(target, gaussians, view, converter)
            elif kind in CONVERTED and converter is not None:
                converter.convert(source, target)
    return {name if kind == "ply" else f"{name}_{kind}": f"{name}.{kind}" for kind in formats}
