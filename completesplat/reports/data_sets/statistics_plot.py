"""The histograms of a data set as one picture."""

from pathlib import Path
from typing import Any

import numpy as np

from completesplat.export.atomic import atomic_path

# Measure, what is counted, the axis.
PANELS = [
    ("frames_per_sequence", "Length", "frames of a sequence"),
    ("fov_degrees", "Field of view", "horizontal angle, degrees"),
    ("largest_angle_degrees", "Turn", "largest angle between two views, degrees"),
    ("distance_from_first", "Baseline", "largest distance from the first camera, scene units"),
    ("near", "Near", "nearest depth, scene units"),
    ("far", "Far", "farthest depth, scene units"),
]
DASHES = ["-", "--", ":"]


def plot_statistics(results: dict[str, Any], path: Path, title: str = "") -> None:
    """Write a PNG with a histogram over the sequences for six measures of `statistics`, one line for each split."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7), layout="constrained")
    total = {split: summary["sequences"] for split, summary in results["splits"].items()}
    numbers = ", ".join(f"{count:,} {split}" for split, count in total.items())
    figure.suptitle(f"{title}: sequences {numbers}" if title else f"Sequences: {numbers}")
    for panel, (key, heading, label) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
        histogram = results["histograms"][key]
        for index, (split, count) in enumerate(total.items()):
            if count:
                shares = 100 * np.array(histogram["counts"][split]) / count
                style: dict[str, Any] = {"color": f"C{index}", "linestyle": DASHES[index % len(DASHES)]}
                panel.stairs(shares, histogram["edges"], baseline=None, linewidth=1.8, label=split, **style)
                panel.stairs(shares, histogram["edges"], fill=True, alpha=0.15, color=f"C{index}")
        panel.set(title=heading, xlabel=label, ylabel="sequences of the split, %")
        panel.set_ylim(bottom=0)
        panel.grid(alpha=0.3)
    if any(total.values()):
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(total))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
