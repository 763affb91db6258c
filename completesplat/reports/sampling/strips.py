"""A figure of picture strips in rows and columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.pixels import to_bytes

READABLE_SIDE = 0.9
"""Inches of a picture."""
GAP = 1
"""Pixels between the pictures of a strip."""


@dataclass(frozen=True)
class Strip:
    """Pictures side by side under a label."""

    images: Float[Tensor, "picture 3 height width"]
    label: str = ""
    marked: bool = False


def draw_strips(rows: Sequence[Sequence[Strip | None]], names: Sequence[str], path: Path, title: str) -> None:
    """Write a PNG; None leaves a place empty.

    Args:
        rows: of equal length.
        names: of the rows.
    """
    from matplotlib.figure import Figure

    widths = [max(len(strip.images) for strip in column if strip) for column in zip(*rows, strict=True)]
    size = (READABLE_SIDE * sum(widths) + 1.2, (READABLE_SIDE + 0.3) * len(rows) + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(rows), len(widths), squeeze=False, width_ratios=widths)
    for row, name, places in zip(rows, names, panels, strict=True):
        places[0].set_ylabel(name, fontsize=8)
        for strip, panel, width in zip(row, places, widths, strict=True):
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
            if strip is not None:
                panel.imshow(to_bytes(_side_by_side(strip.images, width)), interpolation="nearest")
                weight = "bold" if strip.marked else "normal"
                panel.set_title(strip.label, fontsize=8, fontweight=weight, color="crimson" if strip.marked else "k")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _side_by_side(images: Float[Tensor, "picture 3 height width"], count: int) -> Float[Tensor, "3 height _"]:
    """With white in the place of missing pictures, so that all have one scale."""
    white = torch.ones_like(images[0])
    pictures = [*images, *[white] * (count - len(images))]
    return torch.cat([part for image in pictures for part in (image, white[..., :GAP])], dim=-1)[..., :-GAP]
