"""Completions of partly hidden inputs, side by side."""

import math
from collections.abc import Sequence
from itertools import cycle

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.scene import SceneBatch
from completesplat.studies.figures import Strip
from completesplat.studies.samples import SampleRenderer


def check_box(box: Sequence[float]) -> None:
    """`CompleteSplatError` for what is no box in shares of a picture, has no pixels, or reaches out of the picture."""
    if len(box) != 4 or not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
        raise CompleteSplatError(f"boxes: {list(box)} is no [x0,y0,x1,y1] with 0 <= x0 < x1 <= 1 and so on")


def box_visibility(box: Sequence[float], size: int) -> Float[Tensor, "1 size size"]:
    """1 outside of a box [x0 y0 x1 y1] in shares of the square, 0 in the pixels that it touches."""
    left, upper, right, lower = box
    visible = torch.ones(1, size, size)
    rows, columns = (slice(math.floor(a * size), math.ceil(b * size)) for a, b in ((upper, lower), (left, right)))
    visible[:, rows, columns] = 0
    return visible


def strips(
    renderer: SampleRenderer,
    scenes: Sequence[SceneBatch],
    boxes: Sequence[Sequence[float]],
    views: int,
    guidance_weight: float,
) -> tuple[list[list[Strip | None]], list[str]]:
    """Rows of three columns for each scene and their names: the truth, then its completions, without skips.

    The columns are the input (complete in the truth's row), the reference view, and other views evenly spread over the
    targets. The boxes take turns.
    """
    rows: list[list[Strip | None]] = []
    names = []
    for scene, box in zip(scenes, cycle(boxes), strict=False):
        visible = box_visibility(box, scene.reference.images.shape[-1]).to(scene.reference.images)
        images = renderer(scene, visible=visible[None], guidance_weight=guidance_weight)
        count = images.shape[1] - 1
        shown = [1 + i * count // views for i in range(min(views, count))]
        true = scene.all_views().images[0]
        rows.append([Strip(true[:1], "input"), Strip(true[:1], "reference view"), Strip(true[shown], "other views")])
        names.append(f"{scene.names[0]}\ntruth")
        for sample, drawn in enumerate(images):
            # Grey, as black may be the picture's own.
            seen = Strip(true[:1] * visible + 0.5 * (1 - visible), "what is seen") if sample == 0 else None
            rows.append([seen, Strip(drawn[:1]), Strip(drawn[shown])])
            names.append(f"sample {sample}")
    return rows, names
