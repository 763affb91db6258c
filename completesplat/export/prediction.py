"""All files of one prediction: splats, videos, a contact sheet, maps and a description."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.atomic import make_folder, write_text
from completesplat.export.cleaning import beyond_gamut, cleaned, transparent, with_screen_space_dilation
from completesplat.export.formats import write_formats
from completesplat.export.pictures import (
    SheetCell,
    color_depth,
    color_normals,
    picture_sheet,
    surface_depth,
    to_bytes,
    write_png,
)
from completesplat.export.ply import write_ply
from completesplat.export.splat_transform import PageView, SplatTransform
from completesplat.export.video import orbit_views, render_views, write_video
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.geometry.surfaces import normals_from_depth
from completesplat.geometry.trajectories import PATHS
from completesplat.rasterizers import Rasterizer

DIRECTIONS = 8
CONVENTIONS = {
    "axes": "OpenCV: +x right, +y down, +z forward, seen from the reference camera",
    "world_to_camera": "4 x 4, rows first; maps homogeneous world points (as columns) to camera points",
    "intrinsics": "3 x 3, rows first, in pixels; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)",
    "image_size": "(height, width) in pixels",
    "units": "the data set's or model's own scale; not metres",
    "quaternions": "(w, x, y, z), unit length",
    "colors": "sRGB, 0 to 1, the same from every direction",
}


@dataclass(frozen=True)
class Wanted:
    """What to write of each prediction.

    Args:
        formats: of the scenes, out of `completesplat.export.formats.FORMATS`; some need the converter.
        videos: camera paths, out of `completesplat.geometry.trajectories.PATHS`; each video has `frames`.
        background: grey value where a scene leaves a pixel open.
        maps: depth, normals and opacity of the reference view, see `write_maps`.
        screen_space_dilation: store Gaussians `with_screen_space_dilation`.
    """

    formats: Sequence[str] = ("ply",)
    videos: Sequence[str] = ("orbit",)
    frames: int = 48
    background: float = 0.5
    maps: bool = False
    converter: SplatTransform | None = None
    screen_space_dilation: bool = True


@dataclass(frozen=True)
class SampleViews:
    """One sample: its renderings from several directions, and the depth seen from the first of them."""

    label: str
    images: Float[Tensor, "view 3 height width"]
    depth: Float[Tensor, "1 height width"]


def write_prediction(
    folder: Path,
    image: Float[Tensor, "3 size size"],
    scenes: Sequence[Gaussians],
    reference: Cameras,
    rasterizer: Rasterizer,
    up: Float[Tensor, "3"],
    wanted: Wanted,
    settings: Mapping[str, Any],
    on_sample: Callable[[], None] = lambda: None,
) -> None:
    """Write `sample_00.ply`, `orbit_00.mp4`, ..., `sheet.png` and `scene.json`.

    Args:
        image, reference: the input image and its camera.
        scenes: the samples, in the reference camera's frame; what cannot be drawn is left out, with a warning.
        up: where up is in the scene; the views turn about it.
        settings: recorded in `scene.json`; must hold the seed and the image's name.
        on_sample: called when a sample's files are written.

    `CompleteSplatError`: a sample without anything to draw, or a converter that fails; `DiskError`: a full disk, or the
    folder's own one is missing.
    """
    # Before anything is written: a sample of which nothing is left is refused.
    scenes = [cleaned(scene, f"{settings['image']}: sample {i}") for i, scene in enumerate(scenes)]
    make_folder(folder)
    rows: list[SampleViews] = []
    files: dict[str, str] = {}
    for i, scene in enumerate(scenes):
        comments = [*(f"{name} {value}" for name, value in settings.items()), f"sample {i}"]
        row, written = _write_sample(folder, i, scene, reference, rasterizer, up, wanted, comments)
        rows.append(row)
        files |= written
        on_sample()
    contact_sheet(folder / "sheet.png", f"{settings['image']}: views around each sample", image, rows)
    recorded = {**settings, "gaussians": [scene.count for scene in scenes], "up": up.tolist()}
    recorded["colors_clipped"] = [int(beyond_gamut(scene).sum()) for scene in scenes]
    if "spz" in wanted.formats:
        recorded["left_out_of_spz"] = [int(transparent(scene).sum()) for scene in scenes]
    if wanted.maps:
        written, ends = write_maps(folder, scenes, reference, rasterizer)
        files |= written
        recorded["depth_map_ends"] = list(ends)
    write_scene_json(folder / "scene.json", reference, recorded, settings["seed"], {**files, "sheet": "sheet.png"})


def write_fitted_scene(
    folder: Path,
    name: str,
    scene: Gaussians,
    cameras: Cameras,
    images: Float[Tensor, "view 3 height width"],
    truth: Float[Tensor, "view 3 height width"],
    seed: int,
) -> None:
    """Write `scene.ply`, `sheet.png` (true pictures and those of the scene, at most 8) and `scene.json`.

    Args:
        scene: in the frame of the first camera, where up is where it is in that camera's picture.
        images, truth: what the cameras see of the scene, and what they should see.

    `CompleteSplatError`: nothing of the scene can be stored.
    """
    make_folder(folder.parent)
    make_folder(folder)
    stored = with_screen_space_dilation(cleaned(scene, name), cameras[0])
    write_ply(folder / "scene.ply", stored, [f"scene {name}"])
    shown = sorted({i * len(images) // DIRECTIONS for i in range(DIRECTIONS)})
    rows = [
        [SheetCell(pictures[i].clamp(0, 1), label if i == 0 else "") for i in shown]
        for label, pictures in (("true", truth), ("fitted", images))
    ]
    write_png(folder / "sheet.png", picture_sheet([f"view {i}" for i in shown], rows, name))
    files = {"scene": "scene.ply", "sheet": "sheet.png"}
    settings = {"scene": name, "gaussians": [stored.count], "screen_space_dilation": True}
    write_scene_json(folder / "scene.json", cameras[0], settings, seed, files)


def _write_sample(
    folder: Path,
    index: int,
    scene: Gaussians,
    reference: Cameras,
    rasterizer: Rasterizer,
    up: Float[Tensor, "3"],
    wanted: Wanted,
    comments: Sequence[str],
) -> tuple[SampleViews, dict[str, str]]:
    """A sample's splats and videos, and its row of the contact sheet; the files' names by purpose."""
    pivot = seen_center(rasterizer, scene, reference)
    view = PageView(reference, pivot, up, wanted.background)
    stored = with_screen_space_dilation(scene, reference) if wanted.screen_space_dilation else scene
    files = write_formats(folder, f"sample_{index:02}", stored, wanted.formats, view, wanted.converter, comments)
    for kind in wanted.videos:
        files[f"{kind}_{index:02}"] = f"{kind}_{index:02}.mp4"
        cameras = PATHS[kind](reference, pivot, up, wanted.frames)
        frames, _ = render_views(rasterizer, scene, cameras, wanted.background)
        write_video(folder / f"{kind}_{index:02}.mp4", frames)
    views, depths = orbit_views(rasterizer, scene, reference, pivot, DIRECTIONS, wanted.background, up)
    return SampleViews(f"sample {index}", views, depths[0]), files


@torch.no_grad()
def seen_center(rasterizer: Rasterizer, scene: Gaussians, reference: Cameras) -> Float[Tensor, "3"]:
    """The point that a turn goes around: on the optical axis, at the median depth of the image's central ninth.

    Where nothing is seen there, the median depth of all Gaussians stands in.
    """
    depth = rasterizer(scene[None], reference[None][None]).expected_depth()[0, 0, 0]
    height, width = depth.shape
    center = depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
    seen = center[center > 0]
    if len(seen) == 0:
        seen = transform_points(reference.world_to_camera, scene.means)[:, 2]
    return reference.camera_to_world[:3, 3] + reference.camera_to_world[:3, 2] * seen.median()


def contact_sheet(
    path: str | Path, title: str, reference: Float[Tensor, "3 height width"], samples: Sequence[SampleViews]
) -> None:
    """Write a PNG: the input image in the first column, then a row for each sample with its views and its depth.

    Depth is coloured on one scale for all rows. The views, as many for all samples, are evenly spread over a turn.
    """
    depths, (near, far) = color_depth(torch.stack([sample.depth for sample in samples]))
    rows = [
        [None, SheetCell(sample.images[0], sample.label), *map(SheetCell, sample.images[1:]), SheetCell(depth)]
        for sample, depth in zip(samples, depths, strict=True)
    ]
    rows[0][0] = SheetCell(reference)
    views = len(samples[0].images)
    headings = ["input", *(f"{360 / views * k:g}°" for k in range(views)), f"depth {near:.3g} to {far:.3g}"]
    write_png(Path(path), picture_sheet(headings, rows, title))


@torch.no_grad()
def write_maps(
    folder: Path, scenes: Sequence[Gaussians], camera: Cameras, rasterizer: Rasterizer
) -> tuple[dict[str, str], tuple[float, float]]:
    """Write `depth_00.png`, `normals_00.png`, `opacity_00.png` and so on: what a camera sees of each scene.

    Depth is coloured as in `color_depth`, on one scale for all scenes, normals as in `color_normals`; both are grey
    where a pixel is not more than half opaque. Opacity is white where nothing shines through.

    Returns:
        The files' names by purpose, and the depths at the ends of the scale.
    """
    views = [rasterizer(scene[None], camera[None][None])[0, 0] for scene in scenes]
    depth = torch.stack([surface_depth(view) for view in views])
    depth_pictures, ends = color_depth(depth)
    files = {}
    for index, view in enumerate(views):
        pictures = {
            "depth": depth_pictures[index],
            "normals": color_normals(normals_from_depth(depth[index], camera)),
            "opacity": view.alpha.expand(3, -1, -1),
        }
        for kind, picture in pictures.items():
            name = f"{kind}_{index:02}"
            files[name] = f"{name}.png"
            write_png(folder / files[name], Image.fromarray(to_bytes(picture)))
    return files, ends


def write_scene_json(
    path: str | Path, reference: Cameras, settings: Mapping[str, Any], seed: int, files: Mapping[str, str]
) -> None:
    """Write the scene description as plain JSON; `ValueError` for a number that is not finite (JSON has none).

    `settings` are what the scene was made with, as plain values, `files` the names of those beside it, by purpose.
    """
    scene = {
        "format": "completesplat scene 1",
        "reference_camera": plain_camera(reference),
        "conventions": CONVENTIONS,
        "settings": dict(settings),
        "seed": seed,
        "files": dict(files),
    }
    write_text(path, json.dumps(scene, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def plain_camera(camera: Cameras) -> dict[str, Any]:
    """One camera as JSON holds it."""
    matrices = {"world_to_camera": camera.world_to_camera.tolist(), "intrinsics": camera.intrinsics.tolist()}
    return {**matrices, "image_size": list(camera.image_size)}
