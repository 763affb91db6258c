"""Depth, normals and opacity of rendered views, and their pictures."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.depth_colors import color_depth
from completesplat.export.normal_colors import color_normals
from completesplat.export.pixels import to_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.normals import normals_from_depth
from completesplat.rasterizers import Rasterizer, Rendering

OPAQUE = 0.5


def surface_depth(rendering: Rendering) -> Float[Tensor, "*batch 1 height width"]:
    """The expected depth of pixels that are more than half opaque; 0 elsewhere, where no surface is seen."""
    return torch.where(rendering.alpha > OPAQUE, rendering.expected_depth(), 0)


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
            with atomic_path(folder / files[name]) as temporary:
                Image.fromarray(to_bytes(picture)).save(temporary, format="PNG")
    return files, ends
