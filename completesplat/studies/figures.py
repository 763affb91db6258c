"""Writer of the studies' figures, and images side by side in rows and columns."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from completesplat.export.images import to_bytes
from completesplat.files import atomic_path


@contextmanager
def written_figure(
    path: Path, title: str, size: tuple[float, float], dpi: int = 110, layout: str | None = "constrained"
) -> Iterator[Figure]:
    """Yield a figure of this width and height in inches; write it as a PNG if the block ends without exception."""
    figure = Figure(figsize=size, layout=layout)  # type: ignore[arg-type]
    figure.suptitle(title)
    yield figure
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


READABLE_SIDE = 0.9  # of an image, in inches
GAP = 1  # between the images of a strip, in pixels


@dataclass(frozen=True)
class Strip:
    """Images side by side under a label."""

    images: Float[Tensor, "picture 3 height width"]
    label: str = ""
    marked: bool = False


def draw_strips(rows: Sequence[Sequence[Strip | None]], names: Sequence[str], path: Path, title: str) -> None:
    """Write a PNG of rows of equal length and their names; None leaves a place empty."""
    widths = [max(len(strip.images) for strip in column if strip) for column in zip(*rows, strict=True)]
    size = (READABLE_SIDE * sum(widths) + 1.2, (READABLE_SIDE + 0.3) * len(rows) + 0.5)
    with written_figure(path, title, size, dpi=130) as figure:
        panels = figure.subplots(len(rows), len(widths), squeeze=False, width_ratios=widths)
        for row, name, places in zip(rows, names, panels, strict=True):
            places[0].set_ylabel(name, fontsize=8)
            for strip, panel, width in zip(row, places, widths, strict=True):
                panel.set(xticks=[], yticks=[])
                panel.spines[:].set_visible(False)
                if strip is not None:
                    panel.imshow(to_bytes(_side_by_side(strip.images, width)), interpolation="nearest")
                    weight, color = ("bold", "crimson") if strip.marked else ("normal", "k")
                    panel.set_title(strip.label, fontsize=8, fontweight=weight, color=color)


def _side_by_side(images: Float[Tensor, "picture 3 height width"], count: int) -> Float[Tensor, "3 height _"]:
    """Join images to a row of `count`; white replaces missing ones, so that all rows have one scale."""
    white = torch.ones_like(images[0])
    pictures = [*images, *[white] * (count - len(images))]
    return torch.cat([part for image in pictures for part in (image, white[..., :GAP])], dim=-1)[..., :-GAP]
