"""Samplers against their denoiser calls, as one picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from completesplat.export.atomic import atomic_path
from completesplat.reports.sampling.samplers import CLOSE

PANELS = [
    ("psnr", "PSNR of novel views, dB"),
    ("ssim", "SSIM of novel views"),
    ("agreement", "PSNR against 50 steps of DDIM, dB"),
    ("diversity", "Difference of two samples (RMS)"),
    ("ms", "Time of a sample, ms"),
]
MARKERS = "osD^v"


def plot_samplers(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Write a PNG with a panel for each measure and a line for each sampler; the grey band is 0.1 dB wide each way."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

    figure = Figure(figsize=(17, 4), layout="constrained")
    figure.suptitle(title)
    names = list(dict.fromkeys(row["sampler"] for row in rows))
    for panel, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        # The reference agrees with itself, at the limit of PSNR.
        shown = rows[1:] if key == "agreement" else rows
        for index, name in enumerate(names):
            own = sorted((row["calls"], row[key]) for row in shown if row["sampler"] == name)
            if own:
                panel.plot(*zip(*own, strict=True), color=f"C{index}", marker=MARKERS[index % 5], label=name)
        if key == "psnr":
            panel.axhspan(rows[0][key] - CLOSE, rows[0][key] + CLOSE, color="0.85", zorder=0)
        panel.set(xscale="log", xlabel="denoiser calls", title=label)
        panel.set_xticks(sorted({row["calls"] for row in rows} & {1, 2, 5, 10, 20, 50}))
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter("")
        panel.grid(alpha=0.3)
        if key in ("diversity", "ms"):
            panel.set_ylim(bottom=0)
    figure.axes[0].legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
