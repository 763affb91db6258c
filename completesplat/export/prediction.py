"""All files of one prediction: the photo, splats, videos, a contact sheet, maps and a description."""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn import functional

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import beyond_gamut, cleaned, transparent
from completesplat.export.description import SCENE_FILE, is_described, write_scene_json
from completesplat.export.formats import FORMATS
from completesplat.export.formats import suffix as format_suffix
from completesplat.export.images import SheetCell, color_depth, color_normals, image_sheet, strip, to_pixels, write_png
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.scene_files import OutputFiles, write_scene
from completesplat.export.subject import all_around, subject_of
from completesplat.export.video import render_views
from completesplat.files import make_folder, write_text
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.geometry.surfaces import normals_from_depth
from completesplat.geometry.trajectories import PATHS, turned
from completesplat.rasterizers import Rasterizer

logger = logging.getLogger(__name__)

ANGLES = (0, 15, 30, 60, 90, 180, 270, 330)  # degrees of the views around a sample on the contact sheet
SHEET_SIDE = 256  # pixels of its images, at most
PHOTO_FILE = "photo.png"
SHEET_FILE = "sheet.png"
UNFINISHED = ".unfinished"  # a file that is there until the others are written
SPLATS = "|".join(map(format_suffix, FORMATS))
VIDEOS = "|".join(PATHS)
SCENES = rf"sample_\d+({SPLATS})|({VIDEOS})_\d+\.mp4"
MAPS = r"(depth|normals|opacity)_\d+\.png"
WRITTEN = re.compile(rf"{SCENES}|{MAPS}|{SHEET_FILE}|{PHOTO_FILE}|{SCENE_FILE}")


def write_prediction(
    folder: Path,
    image: Float[Tensor, "3 size size"],
    samples: Sequence[PlacedScene],
    rasterizer: Rasterizer,
    outputs: OutputFiles,
    settings: Mapping[str, Any],
    on_file: Callable[[str], None] = lambda name: None,
) -> None:
    """Write `photo.png`, `sample_00.ply`, `orbit_00.mp4`, ..., `sheet.png` and, when all is done, `scene.json`.

    The files of an earlier prediction in the folder, finished or not, are removed first; others remain.

    Args:
        image: the input image, with the size of the samples' camera.
        samples: all with the image's camera; broken Gaussians are left out, with a warning.
        settings: recorded in `scene.json`; must hold the seed and the image's name.
        on_file: called with the name of each scene's file and video before it is written.

    Raises:
        CompleteSplatError: all Gaussians of a sample are broken, a converter fails, or files of such names are there
            that no prediction wrote.
        DiskError: the disk is full, or the folder above `folder` is missing.
    """
    # Refuse samples without intact Gaussians before anything is written.
    samples = [_prepared(sample, f"{settings['image']}: sample {i}") for i, sample in enumerate(samples)]
    make_folder(folder)
    _make_room(folder)
    write_png(folder / PHOTO_FILE, Image.fromarray(to_pixels(image)))
    # Scenes do not depend on hidden pixels, of which the digest `made_from` does.
    comments = [f"{name} {value}" for name, value in settings.items() if name != "made_from"]
    files = {"photo": PHOTO_FILE}
    views = []
    depths = []
    for i, sample in enumerate(samples):
        number = f"{i:02}"
        lines = [*comments, f"sample {i}"]
        files.update(write_scene(folder, f"sample_{number}", f"_{number}", sample, rasterizer, outputs, lines, on_file))
        around, depth = _views_around(sample, rasterizer, outputs.background)
        views.append(around)
        depths.append(depth)
    title = f"{settings['image']}: views around each sample"
    small = functional.interpolate(image[None], views[0].shape[-2:], mode="bilinear", antialias=True)[0]
    contact_sheet(folder / SHEET_FILE, title, small, torch.stack(views), torch.stack(depths))
    recorded = {**settings, **_facts(samples, outputs)}
    if outputs.maps:
        maps, ends = write_maps(folder, [sample.gaussians for sample in samples], samples[0].camera, rasterizer)
        files.update(maps)
        recorded["depth_map_ends"] = list(ends)
    files["sheet"] = SHEET_FILE
    write_scene_json(folder / SCENE_FILE, samples[0].camera, recorded, settings["seed"], files)
    (folder / UNFINISHED).unlink()


def _prepared(sample: PlacedScene, name: str) -> PlacedScene:
    """Return a sample without broken Gaussians. Errors and warnings have its `name`."""
    return replace(sample, gaussians=cleaned(sample.gaussians, name))


def _make_room(folder: Path) -> None:
    """Remove the files of an earlier prediction, finished or not, but refuse files with such names of anybody else."""
    old = sorted(file for file in folder.iterdir() if WRITTEN.fullmatch(file.name))
    if is_described(folder):
        logger.info("%s: an earlier prediction is replaced", folder)
    elif old and not (folder / UNFINISHED).is_file():
        raise CompleteSplatError(f"{folder}: {old[0].name} is there, which no prediction wrote; give another out=")
    write_text(folder / UNFINISHED, "")
    for file in old:
        file.unlink()


def _views_around(
    sample: PlacedScene, rasterizer: Rasterizer, background: float
) -> tuple[Float[Tensor, "view 3 height width"], Float[Tensor, "1 height width"]]:
    """Return views of a sample at `ANGLES`, and the depth of the first, which is the photo's."""
    side = max(sample.camera.image_size)
    camera = crop_resize(sample.camera, 0, 0, side, min(side, SHEET_SIDE))
    subject = subject_of(sample, rasterizer)
    angles = torch.tensor(ANGLES).deg2rad().to(sample.up)
    cameras = turned(all_around(camera, subject), subject.center, sample.up, angles)
    cameras.world_to_camera[0] = camera.world_to_camera
    cameras = replace(cameras, intrinsics=cameras.intrinsics.clone())
    cameras.intrinsics[0] = camera.intrinsics
    views, depths = render_views(rasterizer, sample.gaussians, cameras, background)
    return views, depths[0]


def _facts(samples: Sequence[PlacedScene], outputs: OutputFiles) -> dict[str, object]:
    """Return what `scene.json` records of the samples: counts of Gaussians, and the direction up."""
    eye = samples[0].camera.centers
    scenes = [sample.gaussians for sample in samples]
    facts: dict[str, object] = {
        "gaussians": [scene.count for scene in scenes],
        "up": samples[0].up.tolist(),
        "colors_clipped": [int(beyond_gamut(scene.seen_from(eye)).sum()) for scene in scenes],
    }
    if "spz" in outputs.formats:
        facts["left_out_of_spz"] = [int(transparent(scene).sum()) for scene in scenes]
    return facts


def contact_sheet(
    path: Path,
    title: str,
    reference: Float[Tensor, "3 height width"],
    views: Float[Tensor, "sample view 3 height width"],
    depths: Float[Tensor, "sample 1 height width"],
) -> None:
    """Write a PNG with the input image in the first column, and a row for each sample: views at `ANGLES` and depth.

    Depth is coloured on one scale for all rows.
    """
    colored, (near, far) = color_depth(depths)
    rows = [
        [None, *strip(torch.cat([images, depth[None]]), f"sample {index}")]
        for index, (images, depth) in enumerate(zip(views, colored, strict=True))
    ]
    rows[0][0] = SheetCell(reference)
    angles = [f"{angle}°" for angle in ANGLES]
    write_png(path, image_sheet(["input", *angles, f"depth {near:.3g} to {far:.3g}"], rows, title))


@torch.no_grad()
def write_maps(
    folder: Path, scenes: Sequence[Gaussians], camera: Cameras, rasterizer: Rasterizer
) -> tuple[dict[str, str], tuple[float, float]]:
    """Write the depth, normals and opacity that a camera sees of each scene, as `depth_00.png` and so on.

    Depth is coloured by `color_depth`, on one scale for all scenes, normals by `color_normals`; both are grey where a
    pixel is at most half opaque. Opacity is white where a pixel is fully opaque.

    Returns:
        File names by purpose, and the depths at the ends of the scale.
    """
    views = [rasterizer(scene[None], camera[None][None])[0, 0] for scene in scenes]
    depth = torch.stack([view.surface_depth() for view in views])
    colored, ends = color_depth(depth)
    files = {}
    for index, view in enumerate(views):
        maps = {
            "depth": colored[index],
            "normals": color_normals(normals_from_depth(depth[index], camera)),
            "opacity": view.alpha.expand(3, -1, -1),
        }
        for kind, image in maps.items():
            name = f"{kind}_{index:02}"
            files[name] = f"{name}.png"
            write_png(folder / files[name], Image.fromarray(to_pixels(image)))
    return files, ends
