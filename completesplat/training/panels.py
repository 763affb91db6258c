"""One picture of several scenes: a row of panels for each, with a heading for each column."""

from collections.abc import Mapping

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
GAP, LINE = 4, 16
INK, PAPER = "black", "white"


def scene_panels(
    rasterizer: Rasterizer, gaussians: Gaussians, scenes: SceneBatch, background: float
) -> dict[str, Float[Tensor, "batch 3 height width"]]:
    """Input and first target, what the Gaussians [batch] show from the target's camera, and each layer by itself.

    A layer is as many Gaussians as there are pixels (see `completesplat.splatter_image`). The error is the mean
    absolute difference of the colours, times 4. Depth is linear in inverse depth, near bright, on one scale for a
    scene; where nothing is seen it is black.
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
        "depth": _grey(_brightness(whole.expected_depth())),
        "opacity": _grey(whole.alpha),
    }
    pixels = scenes.reference.images.shape[-2] * scenes.reference.images.shape[-1]
    for layer in range(gaussians.count // pixels):
        part = gaussians[:, layer * pixels : (layer + 1) * pixels]
        panels[f"layer {layer + 1}"] = seen(part).over(background)
    return {name: panel.clamp(0, 1) for name, panel in panels.items()}


def _grey(values: Float[Tensor, "batch 1 height width"]) -> Float[Tensor, "batch 3 height width"]:
    return values.expand(-1, 3, -1, -1)


def _brightness(depth: Float[Tensor, "batch 1 height width"]) -> Float[Tensor, "batch 1 height width"]:
    seen = depth > 0
    inverse = torch.where(seen, 1 / depth, 0)
    nearest = inverse.amax((1, 2, 3), keepdim=True)
    farthest = torch.where(seen, inverse, torch.inf).amin((1, 2, 3), keepdim=True)
    # From dark grey to white, so that what is far is not nothing.
    share = 0.2 + 0.8 * (inverse - farthest) / (nearest - farthest).clamp(min=1e-6)
    return torch.where(seen, share, 0)


def sheet(panels: Mapping[str, Float[Tensor, "batch 3 height width"]]) -> Image.Image:
    """All panels, each enlarged by a whole factor to about 128 px, a column for each name, a row for each scene."""
    height, width = next(iter(panels.values())).shape[-2:]
    factor = max(1, round(READABLE_SIDE / max(height, width)))
    cells = {name: _bytes(panel).repeat(factor, 1).repeat(factor, 2) for name, panel in panels.items()}
    tall, wide = height * factor + GAP, width * factor + GAP
    rows = len(next(iter(cells.values())))
    picture = Image.new("RGB", (GAP + wide * len(cells), LINE + tall * rows), PAPER)
    draw = ImageDraw.Draw(picture)
    for column, (name, images) in enumerate(cells.items()):
        left = GAP + column * wide
        draw.text((left, 2), name, INK)
        for row, image in enumerate(images):
            picture.paste(Image.fromarray(image), (left, LINE + row * tall))
    return picture


def _bytes(images: Float[Tensor, "batch 3 height width"]) -> UInt8[np.ndarray, "batch height width 3"]:
    return images.nan_to_num().mul(255).round().byte().movedim(1, -1).cpu().numpy()
