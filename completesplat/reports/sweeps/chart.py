"""The headline figure of a sweep as one picture."""

import math
from pathlib import Path
from typing import Any

from completesplat.export.atomic import atomic_path
from completesplat.reports.sweeps.summary import NOTHING, Summary

COLUMN = "full_novel_psnr"
AXIS = "PSNR of novel views, all pixels (dB)"
LINES = {"mean_image": "--", "copy_reference": ":"}


def plot_summary(summary: Summary, path: Path) -> None:
    """Write a PNG: a bar for each setting with its deviation over seeds, the naive predictors as upright lines."""
    from matplotlib.figure import Figure

    ours = [row for row in summary.rows if row["seeds"] is not None]
    figure = Figure(figsize=(9, 1.6 + 0.42 * max(len(ours), 2)), layout="constrained")
    axes = figure.subplots()
    if not ours:
        axes.text(0.5, 0.5, NOTHING, ha="center", va="center")
        axes.set_axis_off()
    else:
        _draw(axes, ours, [row for row in summary.rows if row["seeds"] is None])
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axes: Any, ours: list[dict[str, Any]], naive: list[dict[str, Any]]) -> None:
    means = [_finite(row, "mean") for row in ours]
    deviations = [_finite(row, "deviation") for row in ours]
    bars = axes.barh(range(len(ours)), means, xerr=deviations, capsize=3, color="C0", height=0.7)
    axes.set_yticks(range(len(ours)), [row["ablation"] for row in ours])
    written = ["" if math.isnan(mean) else f"{mean:.2f}" for mean in means]
    axes.bar_label(bars, written, padding=4)
    for row in naive:
        value = _finite(row, "mean")
        if row["ablation"] in LINES and not math.isnan(value):
            style = LINES[row["ablation"]]
            axes.axvline(
                value, color="black", linestyle=style, label=f"{row['ablation'].replace('_', ' ')}, {value:.2f}"
            )
    axes.invert_yaxis()  # as in the table, the first row is on top
    axes.margins(x=0.1)
    axes.set_xlim(left=0)
    axes.set_xlabel(AXIS)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    if axes.get_legend_handles_labels()[0]:
        axes.figure.legend(loc="outside upper right", ncols=len(LINES))


def _finite(row: dict[str, Any], kind: str) -> float:
    """Not-a-number, which is not drawn, for all that has no place on an axis."""
    value = row.get(f"{COLUMN}_{kind}")
    return value if value is not None and math.isfinite(value) else math.nan
