"""Files of a scene that was fitted to photos: splats, a sheet of true and rendered images, and a description."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from completesplat.export.cleaning import cleaned, with_screen_space_dilation
from completesplat.export.description import SCENE_FILE, write_scene_json
from completesplat.export.images import SheetCell, image_sheet, strip, write_png
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.ply import write_ply
from completesplat.export.video import Frames
from completesplat.wording import printable

logger = logging.getLogger(__name__)

MOST_VIEWS = 8  # on a sheet
LONGEST_NAME = 18  # characters above a column of a sheet


@dataclass(frozen=True)
class FittedViews:
    """Views that a fitted scene is compared with.

    Attributes:
        rendered, true: images of all views.
        names: names of the photos, where they are known.
    """

    rendered: Frames
    true: Frames
    names: tuple[str, ...] = ()

    def sheet_name(self, index: int) -> str:
        """Return the name of a view for the sheet."""
        return printable(self.names[index], LONGEST_NAME) if self.names else f"view {index}"


def write_fitted_scene(
    folder: Path,
    name: str,
    title: str,
    scene: PlacedScene,
    views: FittedViews,
    seed: int,
    others: Mapping[str, str] | None = None,
) -> None:
    """Write `scene.ply`, `sheet.png` (true and rendered images of at most 8 views, with PSNR) and `scene.json`.

    Args:
        title: heading of the sheet; says what the scene was fitted to.
        scene: the scene and its first view's camera. If its files have an offset, it is recorded, and a line says so.
        others: other files of the scene by purpose, for `scene.json`.

    Raises:
        CompleteSplatError: no Gaussian of the scene can be stored.
    """
    dilated = with_screen_space_dilation(cleaned(scene.gaussians, name), scene.camera)
    stored = scene.coordinates.gaussians(dilated)
    write_ply(folder / "scene.ply", stored, [f"scene {name}"])
    _write_sheet(folder / "sheet.png", title, views)
    settings = {
        "scene": name,
        "gaussians": [stored.count],
        "screen_space_dilation": True,
        "up": scene.up.tolist(),
    }
    offset = scene.coordinates.offset
    if any(offset):
        settings["offset"] = list(offset)
        place = ", ".join(f"{coordinate:g}" for coordinate in offset)
        logger.warning("%s: too far from its origin for float32: add offset (%s) of scene.json", name, place)
    files = {"scene": "scene.ply", "sheet": "sheet.png", **(others or {})}
    write_scene_json(folder / SCENE_FILE, scene.coordinates.camera(scene.camera), settings, seed, files)


def _write_sheet(path: Path, title: str, views: FittedViews) -> None:
    """Write true images of some views above the rendered ones, with the PSNR of each."""
    from completesplat.metrics.images import psnr  # `predict` needs no metrics

    indices = sorted({i * len(views.rendered) // MOST_VIEWS for i in range(MOST_VIEWS)})
    true = views.true[indices]
    fitted = views.rendered[indices].clamp(0, 1)
    scores = psnr(fitted, true).tolist()
    headings = [views.sheet_name(index) for index in indices]
    cells = [SheetCell(image, f"fitted: {score:.2f} dB") for image, score in zip(fitted, scores, strict=True)]
    write_png(path, image_sheet(headings, [strip(true.clamp(0, 1), "true"), [*cells]], title))
