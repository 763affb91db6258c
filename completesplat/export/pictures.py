"""Tensors as pictures for people: bytes, grids, maps of depth, normals and opacity in colours."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from completesplat.atomic import atomic_path
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.normals import normals_from_depth
from completesplat.rasterizers import Rasterizer, Rendering


def to_bytes(images: Float[Tensor, "*batch 3 height width"]) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Images (sRGB, 0 to 1, clamped) to bytes with the channels last.

    Raises:
        ValueError: values that are not finite.
    """
    if not images.isfinite().all():
        raise ValueError("images hold values that are not finite")
    scaled = images.detach().clamp(0, 1).mul(255).round().to(torch.uint8)
    return scaled.movedim(-3, -1).cpu().numpy()


def enlarge(
    images: Float[Tensor, "*batch channel height width"], factor: int
) -> Float[Tensor, "*batch channel tall wide"]:
    """Repeat every pixel `factor` times in both directions: larger, with nothing invented between the pixels."""
    return images.repeat_interleave(factor, dim=-2).repeat_interleave(factor, dim=-1)


def image_grid(*rows: Float[Tensor, "_ 3 height width"], factor: int = 3) -> Image.Image:
    """Images (sRGB, 0 to 1), each row from the left, white where a row is shorter than the longest.

    Args:
        rows: of images of one size.
        factor: every pixel becomes so many in both directions.

    Raises:
        ValueError: values that are not finite.
    """
    columns = max(len(row) for row in rows)
    filled = [torch.cat([row, torch.ones(columns - len(row), *row.shape[1:]).to(row)]) for row in rows]
    whole = rearrange(torch.stack(filled), "row column rgb height width -> rgb (row height) (column width)")
    return Image.fromarray(to_bytes(enlarge(whole, factor)))


NOTHING = 0.5
# Far to near; lightness rises steadily, so that the picture is also right in grey.
STOPS = [
    [0.05, 0.03, 0.20],
    [0.30, 0.08, 0.45],
    [0.62, 0.18, 0.45],
    [0.90, 0.40, 0.25],
    [0.98, 0.70, 0.20],
    [1.00, 0.98, 0.70],
]


def color_depth(
    depth: Float[Tensor, "*batch 1 height width"],
) -> tuple[Float[Tensor, "*batch 3 height width"], tuple[float, float]]:
    """Colours of depths, linear in inverse depth, far dark and near bright, on one scale for all pictures.

    The scale leaves out the nearest and the farthest 2 % of the pixels, so that stray Gaussians do not flatten the
    rest. A depth of 0 or less, or one that is not finite, means that nothing is seen there: grey.

    Returns:
        The pictures, and the depths at the ends of the scale (0, 0 if nothing is seen at all).
    """
    seen = depth.isfinite() & (depth > 0)
    if not seen.any():
        return torch.full_like(depth, NOTHING).expand(*depth.shape[:-3], 3, *depth.shape[-2:]), (0.0, 0.0)
    ordered = depth[seen].sort().values
    stray = len(ordered) // 50
    near, far = ordered[stray], ordered[-1 - stray]
    inverse = 1 / torch.where(seen, depth, far)
    span = (1 / near - 1 / far).clamp(min=1e-12)
    colors = ramp((inverse - 1 / far) / span)
    return torch.where(seen, colors, NOTHING), (near.item(), far.item())


def ramp(values: Float[Tensor, "*batch 1 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """Colours of values from 0 (dark) to 1 (bright); beyond these the ends' colours."""
    position = values.clamp(0, 1) * (len(STOPS) - 1)
    stops = torch.tensor(STOPS, dtype=values.dtype, device=values.device)
    lower = position.floor().clamp(max=len(STOPS) - 2)
    index = lower.long().squeeze(-3)
    mix = (position - lower).squeeze(-3)[..., None]
    return torch.lerp(stops[index], stops[index + 1], mix).movedim(-1, -3)


def color_normals(normals: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """(n + 1) / 2 of unit normals in the camera's frame, in the axes of normal maps: right, up, towards the viewer.

    What faces the camera is light blue (0.5, 0.5, 1), what faces right is red and what faces up is green. In the
    camera's own axes (+y down, +z forward) that is (1 + x, 1 - y, 1 - z) / 2. No normal (0) is grey.
    """
    signs = torch.tensor([1.0, -1.0, -1.0], dtype=normals.dtype, device=normals.device)
    return (normals * signs[:, None, None] + 1) / 2


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
