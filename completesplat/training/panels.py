"""One picture of several scenes: rows of panels, with a heading for each column."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch

ERROR_GAIN = 4
READABLE_SIDE = 128
GAP, LINE, MARGIN = 4, 16, 72
INK, PAPER = "black", "white"


def scene_panels(
    rasterizer: Rasterizer, gaussians: Gaussians, scenes: SceneBatch, background: float
) -> dict[str, Float[Tensor, "batch 3 height width"]]:
    """Input and first target, what the Gaussians [batch] show from the target's camera, and each layer by itself.

    A layer is as many Gaussians as there are pixels (see `completesplat.splatter_image`). The error is the mean
    absolute difference of the colours, times 4.
    """
    target = scenes.targets[:, :1]

    def seen(part: Gaussians) -> Rendering:
        return rasterizer(part, target.cameras)[:, 0]

    whole = seen(gaussians)
    image = whole.over(background).clamp(0, 1)
    error = (image - target.images[:, 0]).abs().mean(1, keepdim=True)
    panels = {
        "input": scenes.reference.images,
        "target": target.images[:, 0],
        "render": image,
        f"error x{ERROR_GAIN}": _grey(ERROR_GAIN * error),
        "depth": depth_panels(whole.expected_depth()[:, None])[:, 0],
        "opacity": _grey(whole.alpha),
    }
    pixels = scenes.reference.images.shape[-2] * scenes.reference.images.shape[-1]
    for layer in range(gaussians.count // pixels):
        part = gaussians[:, layer * pixels : (layer + 1) * pixels]
        panels[f"layer {layer + 1}"] = seen(part).over(background)
    return {name: panel.clamp(0, 1) for name, panel in panels.items()}


def _grey(values: Float[Tensor, "batch 1 height width"]) -> Float[Tensor, "batch 3 height width"]:
    return values.expand(-1, 3, -1, -1)


def depth_panels(depth: Float[Tensor, "batch view 1 height width"]) -> Float[Tensor, "batch view 3 height width"]:
    """Linear in inverse depth, near bright, on one scale for the views of a scene; black where nothing is seen.

    The scale leaves the nearest and the farthest 2 % of the pixels out: single Gaussians before a camera are common.
    """
    inverse = torch.where(depth > 0, 1 / depth, torch.nan)
    limits = torch.nanquantile(inverse.flatten(1), torch.tensor([0.02, 0.98]).to(inverse), dim=1)
    farthest, nearest = limits[:, :, None, None, None, None]
    # From dark grey to white, so that what is far is not nothing.
    share = 0.2 + 0.8 * ((inverse - farthest) / (nearest - farthest).clamp(min=1e-6)).clamp(0, 1)
    return share.nan_to_num(0).expand(-1, -1, 3, -1, -1)


def sheet(panels: Mapping[str, Float[Tensor, "row 3 height width"]], rows: Sequence[str] = ()) -> Image.Image:
    """All panels, each enlarged by a whole factor to about 128 px, a column for each name, as many rows as they have.

    Args:
        rows: names of the rows, in a margin at the left; none by default, and no margin.
    """
    height, width = next(iter(panels.values())).shape[-2:]
    factor = max(1, round(READABLE_SIDE / max(height, width)))
    cells = {name: _bytes(panel).repeat(factor, 1).repeat(factor, 2) for name, panel in panels.items()}
    tall, wide = height * factor + GAP, width * factor + GAP
    margin = MARGIN if rows else GAP
    picture = Image.new("RGB", (margin + wide * len(cells), LINE + tall * len(next(iter(cells.values())))), PAPER)
    draw = ImageDraw.Draw(picture)
    for row, name in enumerate(rows):
        draw.text((GAP, LINE + row * tall), name, INK)
    for column, (name, images) in enumerate(cells.items()):
        left = margin + column * wide
        draw.text((left, 2), name, INK)
        for row, image in enumerate(images):
            picture.paste(Image.fromarray(image), (left, LINE + row * tall))
    return picture


def _bytes(images: Float[Tensor, "batch 3 height width"]) -> UInt8[np.ndarray, "batch height width 3"]:
    return images.nan_to_num().mul(255).round().byte().movedim(1, -1).cpu().numpy()
