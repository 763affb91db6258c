"""All files of one prediction: splats, videos, a contact sheet and a description."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.export.cleaning import cleaned
from completesplat.export.contact_sheet import Row, contact_sheet
from completesplat.export.formats import write_formats
from completesplat.export.maps import write_maps
from completesplat.export.page import PageView
from completesplat.export.scene_json import write_scene_json
from completesplat.export.splat_transform import SplatTransform
from completesplat.export.video import write_video
from completesplat.export.views import orbit_views, render_views
from completesplat.export.widening import widened
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.geometry.trajectories import PATHS
from completesplat.rasterizers import Rasterizer

DIRECTIONS = 8


@dataclass(frozen=True)
class Wanted:
    """What to write of each prediction.

    Args:
        formats: of the scenes, out of `completesplat.export.formats.FORMATS`.
        videos: camera paths, out of `completesplat.geometry.trajectories.PATHS`.
        frames: of each video.
        background: grey value where a scene leaves a pixel open.
        maps: depth, normals and opacity of the reference view, see `completesplat.export.maps`.
        converter: writes the formats that need one.
        widen: store Gaussians `widened` for viewers, which draw larger pictures than training.
    """

    formats: Sequence[str] = ("ply",)
    videos: Sequence[str] = ("orbit",)
    frames: int = 48
    background: float = 0.5
    maps: bool = False
    converter: SplatTransform | None = None
    widen: bool = True


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
        folder: where to; made when missing.
        image: the input image.
        scenes: the samples, in the reference camera's frame; what cannot be drawn is left out, with a warning.
        reference: the input's camera.
        rasterizer: draws the videos and the sheet.
        up: where up is in the scene; the views turn about it.
        wanted: which files.
        settings: recorded in `scene.json`; must hold the seed and the image's name.
        on_sample: called when a sample's files are written.

    Raises:
        CompleteSplatError: a sample without anything to draw, or a converter that fails.
    """
    # Before anything is written: a sample of which nothing is left is refused.
    scenes = [cleaned(scene, f"{settings['image']}: sample {i}") for i, scene in enumerate(scenes)]
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    files: dict[str, str] = {}
    for i, scene in enumerate(scenes):
        comments = [*(f"{name} {value}" for name, value in settings.items()), f"sample {i}"]
        row, written = _write_sample(folder, i, scene, reference, rasterizer, up, wanted, comments)
        rows.append(row)
        files |= written
        on_sample()
    angles = [360 / DIRECTIONS * k for k in range(DIRECTIONS)]
    contact_sheet(folder / "sheet.png", f"{settings['image']}: views around each sample", image, rows, angles)
    recorded = {**settings, "gaussians": [scene.count for scene in scenes], "up": up.tolist()}
    if wanted.maps:
        written, ends = write_maps(folder, scenes, reference, rasterizer)
        files |= written
        recorded["depth_map_ends"] = list(ends)
    write_scene_json(folder / "scene.json", reference, recorded, settings["seed"], {**files, "sheet": "sheet.png"})


def _write_sample(
    folder: Path,
    index: int,
    scene: Gaussians,
    reference: Cameras,
    rasterizer: Rasterizer,
    up: Float[Tensor, "3"],
    wanted: Wanted,
    comments: Sequence[str],
) -> tuple[Row, dict[str, str]]:
    """A sample's splats and videos, and its row of the contact sheet; the files' names by purpose."""
    pivot = seen_center(rasterizer, scene, reference)
    view = PageView(reference, pivot, up, wanted.background)
    stored = widened(scene, reference) if wanted.widen else scene
    files = write_formats(folder, f"sample_{index:02}", stored, wanted.formats, view, wanted.converter, comments)
    for kind in wanted.videos:
        files[f"{kind}_{index:02}"] = f"{kind}_{index:02}.mp4"
        cameras = PATHS[kind](reference, pivot, up, wanted.frames)
        frames, _ = render_views(rasterizer, scene, cameras, wanted.background)
        write_video(folder / f"{kind}_{index:02}.mp4", frames)
    views, depths = orbit_views(rasterizer, scene, reference, pivot, DIRECTIONS, wanted.background, up)
    return Row(f"sample {index}", views, depths[0]), files


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
