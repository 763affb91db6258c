"""All files of one prediction: splats, orbit videos, a contact sheet and a description."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor

from completesplat.export.contact_sheet import Row, contact_sheet
from completesplat.export.maps import write_maps
from completesplat.export.ply import write_ply
from completesplat.export.scene_json import write_scene_json
from completesplat.export.video import write_video
from completesplat.export.views import orbit_views
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.rasterizers import Rasterizer

DIRECTIONS = 8


def write_prediction(
    folder: Path,
    image: Float[Tensor, "3 size size"],
    scenes: Sequence[Gaussians],
    reference: Cameras,
    rasterizer: Rasterizer,
    up: Float[Tensor, "3"],
    frames: int,
    background: float,
    settings: Mapping[str, Any],
    maps: bool = False,
) -> None:
    """Write `sample_00.ply`, `orbit_00.mp4`, ..., `sheet.png` and `scene.json`.

    Args:
        folder: where to; made when missing.
        image: the input image.
        scenes: the samples, in the reference camera's frame.
        reference: the input's camera.
        rasterizer: draws the videos and the sheet.
        up: where up is in the scene; the views turn about it.
        frames: of each video.
        background: grey value where a scene leaves a pixel open.
        settings: recorded in `scene.json`; must hold the seed.
        maps: depth, normals and opacity of the reference view as well, see `completesplat.export.maps`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows, files, counts = [], {}, []
    for i, scene in enumerate(track(scenes, "writing samples")):
        files[f"sample_{i:02}"], files[f"orbit_{i:02}"] = f"sample_{i:02}.ply", f"orbit_{i:02}.mp4"
        comments = [f"{name} {value}" for name, value in settings.items()]
        counts.append(write_ply(folder / f"sample_{i:02}.ply", scene, [*comments, f"sample {i}"]))
        pivot = seen_center(rasterizer, scene, reference)
        video, _ = orbit_views(rasterizer, scene, reference, pivot, frames, background, up)
        write_video(folder / f"orbit_{i:02}.mp4", video)
        views, depths = orbit_views(rasterizer, scene, reference, pivot, DIRECTIONS, background, up)
        rows.append(Row(f"sample {i}", views, depths[0]))
    angles = [360 / DIRECTIONS * k for k in range(DIRECTIONS)]
    contact_sheet(folder / "sheet.png", f"{settings['image']}: views around each sample", image, rows, angles)
    recorded = {**settings, "gaussians": counts, "up": up.tolist()}
    if maps:
        written, ends = write_maps(folder, scenes, reference, rasterizer)
        files |= written
        recorded["depth_map_ends"] = list(ends)
    write_scene_json(folder / "scene.json", reference, recorded, settings["seed"], {**files, "sheet": "sheet.png"})


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
