"""All files of one prediction: splats, videos, a contact sheet, maps and a description."""

import json
import logging
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.data.validation import read_json
from completesplat.errors import CompleteSplatError, DataError
from completesplat.export.cleaning import beyond_gamut, cleaned, transparent, with_screen_space_dilation
from completesplat.export.formats import FORMATS, write_format
from completesplat.export.formats import suffix as format_suffix
from completesplat.export.images import SheetCell, color_depth, color_normals, image_sheet, strip, to_pixels, write_png
from completesplat.export.mesh import check_available
from completesplat.export.ply import write_ply
from completesplat.export.splat_transform import PageView
from completesplat.export.video import Frames, orbit_views, render_views, write_video
from completesplat.files import make_folder, printable, write_text
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.geometry.surfaces import normals_from_depth
from completesplat.geometry.trajectories import PATHS
from completesplat.quantities import CameraPath, Format
from completesplat.rasterizers import Rasterizer

logger = logging.getLogger(__name__)

DIRECTIONS = 8
SHEET_NAME = 18  # views on a sheet, and characters above a column
PHOTO_FILE = "photo.png"
SCENE_FILE = "scene.json"
UNFINISHED = ".unfinished"  # a file that is there until the others are written
SPLATS = "|".join(map(format_suffix, FORMATS))
VIDEOS = "|".join(PATHS)
SCENES = rf"sample_\d+({SPLATS})|({VIDEOS})_\d+\.mp4"
MAPS = r"(depth|normals|opacity)_\d+\.png"
WRITTEN = re.compile(rf"{SCENES}|{MAPS}|sheet\.png|{PHOTO_FILE}|{SCENE_FILE}")
FARTHEST = 1000.0  # scene radii from the origin, about, where float32 is still finer than a hundredth of a pixel
CONVENTIONS = {
    "axes": "OpenCV's for cameras: +x right, +y down, +z forward; world_to_camera gives the world's",
    "world_to_camera": "4 x 4, rows first; maps homogeneous world points (as columns) to camera points",
    "intrinsics": "3 x 3, rows first, in pixels; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)",
    "image_size": "(height, width) in pixels",
    "units": "the data set's or model's own scale; not metres",
    "offset": "if settings have one: add it to all positions, in float64, for the capture's own coordinates",
    "quaternions": "(w, x, y, z), unit length",
    "colors": "sRGB, 0 to 1; the same from every direction, except where a .ply has f_rest_* (3D Gaussian Splatting's)",
}


@dataclass(frozen=True)
class OutputFiles:
    """Selection of the files that are written for each prediction.

    Raises:
        CompleteSplatError: a format needs a package that is missing.

    Args:
        formats: scene formats; some need `find_splat_transform`.
        videos: camera paths; each video has `frames` frames.
        background: grey value behind the scene.
        pivot_depth: depth on the optical axis around which orbits turn; None: `seen_center` finds it.
        maps: whether to write depth, normals and opacity of the reference view (`write_maps`).
        screen_space_dilation: whether to store Gaussians `with_screen_space_dilation`.
    """

    formats: Sequence[Format] = ("ply",)
    videos: Sequence[CameraPath] = ("orbit",)
    frames: int = 48
    background: float = 0.5
    pivot_depth: float | None = None
    maps: bool = False
    screen_space_dilation: bool = True

    def __post_init__(self) -> None:
        if "mesh" in self.formats:
            check_available()


@dataclass(frozen=True)
class FileUnits:
    """Units and origin of files.

    Attributes:
        scale: units of the world in one unit of the files.
        origin: the world's origin in the user's coordinates, which the files have too, unless they are too far away.
    """

    scale: float = 1.0
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def offset(self) -> tuple[float, ...]:
        """The files' origin in the user's coordinates: 0 unless float32 would be too coarse for these."""
        return self.origin if math.hypot(*self.origin) * self.scale > FARTHEST else (0.0, 0.0, 0.0)

    def stored(self, scene: Gaussians, camera: Cameras) -> tuple[Gaussians, Cameras]:
        """Return a scene and a camera of the world in the files' units."""
        moved = torch.eye(4).to(camera.intrinsics)
        moved[:3, 3] = -self.points(torch.zeros(3))
        camera = camera.scale_world(torch.tensor(1 / self.scale).to(moved))
        scene = replace(scene, means=self.points(scene.means), scales=scene.scales / self.scale)
        return scene, replace(camera, world_to_camera=camera.world_to_camera @ moved)

    def points(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Return points of the world in the files' units."""
        return points / self.scale + torch.tensor(self.origin).sub(torch.tensor(self.offset)).to(points)


@dataclass(frozen=True)
class Shot:
    """A scene and the camera that it is seen by, both in the world, with the units of its files.

    Attributes:
        up: direction up in the world, the axis of orbits.
        photos: names of the photos that it is compared with, where they are known.
    """

    scene: Gaussians
    camera: Cameras
    up: Float[Tensor, "3"] = field(default_factory=lambda: torch.tensor([0.0, -1.0, 0.0]))
    units: FileUnits = FileUnits()
    photos: tuple[str, ...] = ()


def write_prediction(
    folder: Path,
    image: Float[Tensor, "3 size size"],
    shots: Sequence[Shot],
    rasterizer: Rasterizer,
    wanted: OutputFiles,
    settings: Mapping[str, Any],
    on_file: Callable[[str], None] = lambda name: None,
) -> None:
    """Write `photo.png`, `sample_00.ply`, `orbit_00.mp4`, ..., `sheet.png` and, when all is done, `scene.json`.

    The files of an earlier prediction in the folder, finished or not, are removed first; others remain.

    Args:
        image: the input image.
        shots: the samples, all with the image's camera; broken Gaussians are left out, with a warning.
        settings: recorded in `scene.json`; must hold the seed and the image's name.
        on_file: called with the name of each scene's file and video before it is written.

    Raises:
        CompleteSplatError: all Gaussians of a sample are broken, a converter fails, or files of such names are there
            that no prediction wrote.
        DiskError: the disk is full, or the folder above `folder` is missing.
    """
    # Refuse samples without intact Gaussians before anything is written.
    shots = [replace(x, scene=cleaned(x.scene, f"{settings['image']}: sample {i}")) for i, x in enumerate(shots)]
    scenes = [shot.scene for shot in shots]
    reference = shots[0].camera
    make_folder(folder)
    _make_room(folder)
    write_png(folder / PHOTO_FILE, Image.fromarray(to_pixels(image)))
    views = []
    depths = []
    files = {"photo": PHOTO_FILE}
    for i, shot in enumerate(shots):
        # Scenes do not depend on hidden pixels, of which the digest `made_from` does.
        comments = [*(f"{name} {value}" for name, value in settings.items() if name != "made_from"), f"sample {i}"]
        name = f"sample_{i:02}"
        number = f"_{i:02}"
        around, depth, written = write_scene(folder, name, number, shot, rasterizer, wanted, comments, on_file)
        views.append(around)
        depths.append(depth)
        files |= written
    title = f"{settings['image']}: views around each sample"
    contact_sheet(folder / "sheet.png", title, image, torch.stack(views), torch.stack(depths))
    recorded = {**settings, "gaussians": [scene.count for scene in scenes], "up": shots[0].up.tolist()}
    recorded["colors_clipped"] = [int(beyond_gamut(x.seen_from(reference.centers)).sum()) for x in scenes]
    if "spz" in wanted.formats:
        recorded["left_out_of_spz"] = [int(transparent(scene).sum()) for scene in scenes]
    if wanted.maps:
        written, ends = write_maps(folder, scenes, reference, rasterizer)
        files |= written
        recorded["depth_map_ends"] = list(ends)
    write_scene_json(folder / SCENE_FILE, reference, recorded, settings["seed"], {**files, "sheet": "sheet.png"})
    (folder / UNFINISHED).unlink()


def _make_room(folder: Path) -> None:
    """Remove the files of an earlier prediction, finished or not; refuse files with such names of anybody else."""
    old = sorted(file for file in folder.iterdir() if WRITTEN.fullmatch(file.name))
    if is_described(folder):
        logger.info("%s: an earlier prediction is replaced", folder)
    elif old and not (folder / UNFINISHED).is_file():
        raise CompleteSplatError(f"{folder}: {old[0].name} is there, which no prediction wrote; give another out=")
    write_text(folder / UNFINISHED, "")
    for file in old:
        file.unlink()


def write_fitted_scene(
    folder: Path,
    name: str,
    title: str,
    shot: Shot,
    images: Frames,
    truth: Frames,
    seed: int,
    more: Mapping[str, str] | None = None,
) -> None:
    """Write `scene.ply`, `sheet.png` (true and rendered images of at most 8 views, with PSNR) and `scene.json`.

    Args:
        title: heading of the sheet; says what the scene was fitted to.
        shot: the scene and its first view's camera; an offset of its units is recorded, and a line says so.
        images, truth: rendered and true images of all views.
        more: other files of the scene by purpose, for `scene.json`.

    Raises:
        CompleteSplatError: no Gaussian of the scene can be stored.
    """
    from completesplat.metrics.images import psnr  # `predict` needs no metrics

    units = shot.units
    dilated = with_screen_space_dilation(cleaned(shot.scene, name), shot.camera)
    stored, reference = units.stored(dilated, shot.camera)
    write_ply(folder / "scene.ply", stored, [f"scene {name}"])
    indices = sorted({i * len(images) // DIRECTIONS for i in range(DIRECTIONS)})
    true, fitted = (frames[indices].clamp(0, 1) for frames in (truth, images))
    scores = psnr(fitted, truth[indices]).tolist()
    cells = [SheetCell(image, f"fitted: {score:.2f} dB") for image, score in zip(fitted, scores, strict=True)]
    headings = [printable(shot.photos[i], SHEET_NAME) if shot.photos else f"view {i}" for i in indices]
    write_png(folder / "sheet.png", image_sheet(headings, [strip(true, "true"), [*cells]], title))
    settings = {"scene": name, "gaussians": [stored.count], "screen_space_dilation": True, "up": shot.up.tolist()}
    if any(units.offset):
        settings["offset"] = list(units.offset)
        place = ", ".join(f"{coordinate:g}" for coordinate in units.offset)
        logger.warning("%s: too far from its origin for float32: add offset (%s) of scene.json", name, place)
    files = {"scene": "scene.ply", "sheet": "sheet.png", **(more or {})}
    write_scene_json(folder / "scene.json", reference, settings, seed, files)


def write_scene(
    folder: Path,
    name: str,
    suffix: str,
    shot: Shot,
    rasterizer: Rasterizer,
    wanted: OutputFiles,
    comments: Sequence[str],
    on_file: Callable[[str], None] = lambda name: None,
) -> tuple[Frames, Float[Tensor, "1 height width"], dict[str, str]]:
    """Write a scene's splats (`NAME.ply`, ...) in the units of files, and videos (`orbitSUFFIX.mp4`).

    Returns:
        Views around the scene, the first view's depth, and file names by purpose.
    """
    scene = shot.scene
    reference = shot.camera
    pivot = seen_center(rasterizer, scene, reference, wanted.pivot_depth)
    dilated = with_screen_space_dilation(scene, reference) if wanted.screen_space_dilation else scene
    stored, camera = shot.units.stored(dilated, reference)
    view = PageView(camera, shot.units.points(pivot), shot.up, wanted.background)
    files: dict[str, str] = {}
    for kind in wanted.formats:
        on_file(name + format_suffix(kind))
        files |= write_format(folder, name, kind, stored, view, comments, rasterizer)
    for path in wanted.videos:
        files[f"{path}{suffix}"] = f"{path}{suffix}.mp4"
        on_file(f"{path}{suffix}.mp4")
        cameras = PATHS[path](reference, pivot, shot.up, wanted.frames)
        frames, _ = render_views(rasterizer, scene, cameras, wanted.background)
        write_video(folder / f"{path}{suffix}.mp4", frames)
    views, depths = orbit_views(rasterizer, scene, reference, pivot, DIRECTIONS, wanted.background, shot.up)
    return views, depths[0], files


@torch.no_grad()
def seen_center(
    rasterizer: Rasterizer, scene: Gaussians, reference: Cameras, known_depth: float | None = None
) -> Float[Tensor, "3"]:
    """Return the pivot of orbits: the point on the optical axis at the median depth of the image's central ninth.

    If nothing is seen in the central ninth, the median depth of all Gaussians is used. A known depth replaces both.
    """
    forward = reference.camera_to_world[:3, 2]
    if known_depth is not None:
        return reference.camera_to_world[:3, 3] + forward * known_depth
    depth = rasterizer(scene[None], reference[None][None]).expected_depth()[0, 0, 0]
    height, width = depth.shape
    center = depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
    seen = center[center > 0]
    if len(seen) == 0:
        seen = transform_points(reference.world_to_camera, scene.means)[:, 2]
    return reference.camera_to_world[:3, 3] + forward * seen.median()


def contact_sheet(
    path: Path,
    title: str,
    reference: Float[Tensor, "3 height width"],
    views: Float[Tensor, "sample view 3 height width"],
    depths: Float[Tensor, "sample 1 height width"],
) -> None:
    """Write a PNG with the input image in the first column, and a row for each sample with its views and depth.

    Depth is coloured on one scale for all rows. The views are spread evenly over a turn.
    """
    colored, (near, far) = color_depth(depths)
    rows = [
        [None, *strip(torch.cat([images, depth[None]]), f"sample {index}")]
        for index, (images, depth) in enumerate(zip(views, colored, strict=True))
    ]
    rows[0][0] = SheetCell(reference)
    count = views.shape[1]
    headings = ["input", *(f"{360 / count * k:g}°" for k in range(count)), f"depth {near:.3g} to {far:.3g}"]
    write_png(path, image_sheet(headings, rows, title))


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
        normals = color_normals(normals_from_depth(depth[index], camera))
        maps = {"depth": colored[index], "normals": normals, "opacity": view.alpha.expand(3, -1, -1)}
        for kind, image in maps.items():
            name = f"{kind}_{index:02}"
            files[name] = f"{name}.png"
            write_png(folder / files[name], Image.fromarray(to_pixels(image)))
    return files, ends


def write_scene_json(
    path: str | Path, reference: Cameras, settings: Mapping[str, Any], seed: int, files: Mapping[str, str]
) -> None:
    """Write a scene's description, `settings` and `files` as JSON; raise ValueError if a number is not finite."""
    scene = {
        "format": "completesplat scene 1",
        "reference_camera": plain_camera(reference),
        "conventions": CONVENTIONS,
        "settings": dict(settings),
        "seed": seed,
        "files": dict(files),
    }
    write_text(path, json.dumps(scene, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def is_described(folder: Path) -> bool:
    """Return whether a folder has a description of ours, perhaps a damaged one, and not another program's."""
    file = folder / SCENE_FILE
    try:
        content = read_json(file) if file.is_file() else None
    except DataError:
        return True
    return isinstance(content, dict) and "reference_camera" in content


def plain_camera(camera: Cameras) -> dict[str, Any]:
    """Return one camera as values for JSON."""
    matrices = {"world_to_camera": camera.world_to_camera.tolist(), "intrinsics": camera.intrinsics.tolist()}
    return {**matrices, "image_size": list(camera.image_size)}
