"""The benchmark as one picture: what could be there, what was drawn, and how well that fits."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.pixels import to_bytes
from completesplat.metrics.calibration import EDGES
from completesplat.metrics.hidden_modes import REJECTED
from completesplat.reports.hidden_modes.measuring import REGIONS, Shown

SIDE = 1.0
"""Inches of a picture."""
GAP = 0.06
CHARTS = 10.0
"""Inches between pictures, and of the charts' width."""
MEASURES = [
    ("coverage", "coverage\n(best: 1)"),
    ("total_variation", "total variation\n(best: 0)"),
    ("sharpness", "sharpness\n(best: 0)"),
    ("rejected", "rejected\n(best: 0)"),
]
COLORS = {"hidden": "C3", "visible": "C0"}
STYLES = ("o-", "s--")
LOWEST = EDGES[0].item() / 2
"""Where variances (and errors) below the first edge are drawn."""


def draw(
    shown: Sequence[Shown],
    results: Mapping[str, Mapping[str, float]],
    calibration: Mapping[str, Mapping[str, Any]],
    samples: int,
    path: Path,
) -> None:
    """Write a PNG: a row of pictures for each scene, and beside them the scores and the calibration by method."""
    from matplotlib.figure import Figure

    count = 1 + len(shown[0].modes) + len(shown[0].samples)
    height = max(5.4, (SIDE + 0.3) * len(shown) + 0.8)
    width = (SIDE + GAP) * count + 0.3 + CHARTS
    # Laid out by hand: matplotlib's constrained layout takes seconds for so many panels.
    figure = Figure(figsize=(width, height))
    split, top = 1 - CHARTS / width, 1 - 0.7 / height
    bottom = max(0.1, height - 0.7 - (SIDE + 0.3) * len(shown)) / height
    places = {"left": 0.3 / width, "right": split, "top": top, "bottom": bottom}
    grid = figure.add_gridspec(len(shown), count, **places, wspace=GAP / SIDE, hspace=0.3 / SIDE)
    _draw_pictures(grid.subplots(squeeze=False), shown)
    charts = {"left": split + 0.6 / width, "right": 1 - 0.2 / width, "top": top, "bottom": 1.4 / height}
    panels: Any = figure.add_gridspec(1, 2, **charts, wspace=0.22).subplots()
    bars, curves = panels
    _draw_bars(bars, results)
    _draw_calibration(curves, calibration, samples)
    found = next(iter(results.values()))
    title = f"Hidden modes: {found['scenes']} scenes, {found['samples']} samples each"
    figure.suptitle(f"{title}. Input; then from behind: every mode, the true one in green; samples with the mode found")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_pictures(rows: Any, shown: Sequence[Shown]) -> None:
    for panels, scene in zip(rows, shown, strict=True):
        panels[0].set_ylabel(scene.name, fontsize=7)
        _draw_picture(panels[0], scene.reference, "input", "k")
        for mode, panel in enumerate(panels[1 : 1 + len(scene.modes)]):
            _draw_picture(panel, scene.truths[mode], scene.modes[mode], "g" if mode == scene.true_mode else "k")
        for image, found, panel in zip(scene.samples, scene.classes, panels[1 + len(scene.modes) :], strict=True):
            _draw_picture(panel, image, *(("rejected", "0.5") if found == REJECTED else (scene.modes[found], "C1")))


def _draw_picture(panel: Any, image: Float[Tensor, "3 height width"], label: str, color: str) -> None:
    panel.imshow(to_bytes(image), interpolation="nearest")
    panel.set(xticks=[], yticks=[])
    panel.set_title(label, fontsize=8, color=color, pad=2)
    for spine in panel.spines.values():
        spine.set(color=color, linewidth=0.6 if color == "k" else 2)


def _draw_bars(panel: Any, results: Mapping[str, Mapping[str, float]]) -> None:
    width = 0.8 / len(results)
    for index, (method, found) in enumerate(results.items()):
        places = [place + (index + 0.5) * width - 0.4 for place in range(len(MEASURES))]
        values = [found[key] for key, _ in MEASURES]
        bars = panel.bar(places, values, width, label=method.replace("_", " "), color=f"C{index}")
        panel.bar_label(bars, fmt="%.2f", fontsize=7, padding=1)
    panel.set_xticks(range(len(MEASURES)), [label for _, label in MEASURES], fontsize=8)
    panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
    panel.margins(y=0.12)
    panel.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)


def _draw_calibration(panel: Any, calibration: Mapping[str, Mapping[str, Any]], samples: int) -> None:
    for style, (method, found) in zip(STYLES, calibration.items(), strict=False):
        for region in REGIONS:
            bins = found[region]["bins"]
            if bins:
                points = [(max(row["variance"], LOWEST), max(row["squared_error"], LOWEST)) for row in bins]
                label = f"{method.replace('_', ' ')}, {region}"
                panel.plot(*zip(*points, strict=True), style, color=COLORS[region], markersize=4, label=label)
    ends = [LOWEST, 0.3]
    ideal = [(1 + 1 / samples) * end for end in ends]
    panel.plot(ends, ideal, color="0.6", zorder=0, label="calibrated: error = (1 + 1/S) variance")
    panel.set(xscale="log", yscale="log", xlabel="variance of the samples", ylabel="squared error of their mean")
    panel.set_title(f"Pixels by variance; below {EDGES[0].item():.0e}: at the left edge", fontsize=9)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
