"""Faithfulness against diversity as one picture, a curve for each skip weight."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from completesplat.export.atomic import atomic_path

PANELS = [
    ("reference_psnr", "Reference view: PSNR, dB"),
    ("near_object_psnr", "Object in near views: PSNR, dB"),
]


def plot_controls(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Write a PNG with a panel for each measure of faithfulness; the paper's three settings are circled and named."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.5), layout="constrained")
    figure.suptitle(title)
    skips = sorted({row["skip_weight"] for row in rows})
    for panel, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        drawn = [row for row in rows if row[key] is not None]
        for skip in skips:
            own = sorted((r["guidance_weight"], r["diversity"], r[key]) for r in drawn if r["skip_weight"] == skip)
            color = colormaps["viridis"](0.9 * skip)
            panel.plot([p[1] for p in own], [p[2] for p in own], "o-", color=color, label=f"skip weight {skip:g}")
            for weight, x, y in own:
                panel.annotate(f"{weight:g}", (x, y), (4, -9), textcoords="offset points", fontsize=7, color="0.35")
        for row in drawn:
            if row["paper"]:
                x, y = row["diversity"], row[key]
                panel.plot(x, y, "o", markersize=13, fillstyle="none", color="crimson")
                name = f"({row['skip_weight']:g}, {row['guidance_weight']:g})"
                panel.annotate(name, (x, y), (9, 9), textcoords="offset points", color="crimson")
        panel.set(xlabel="diversity: difference of two samples in novel views (RMS)", ylabel=label)
        panel.grid(alpha=0.3)
        panel.margins(0.12)
    figure.axes[0].legend(title="along a curve: guidance weight")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
