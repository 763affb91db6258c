"""Study of samplers and their numbers of steps: quality, diversity, time."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.diffusion.sampling import of_one_kind
from completesplat.metrics.images import psnr, ssim
from completesplat.metrics.scoring import diversity
from completesplat.scene import SceneBatch
from completesplat.studies.figures import written_figure
from completesplat.studies.samples import SampleRenderer, mean_over_scenes

REFERENCES = (("ddim", 50), ("flow", 50))  # for a denoiser that predicts noise, and for flow matching
CLOSE = 0.1  # difference in PSNR, in dB, that is ignored


def rows(
    renderer: SampleRenderer,
    samplers: Mapping[str, Mapping[str, Any]],
    steps: Mapping[str, Sequence[int]],
    scenes: Sequence[SceneBatch],
    settings: Mapping[str, float],
    tick: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Return a row for each fitting sampler and number of steps; the first row is one of `REFERENCES`.

    PSNR and SSIM are of novel views, averaged over samples, views and scenes; `agreement` is the PSNR against the
    reference's renders from the same noise. `ms` is the time per sample of the fastest scene, with its reconstruction
    but without rendering.
    """
    settled: list[Float[Tensor, "sample view 3 height width"]] = []
    trained, table = renderer.model.architecture["sampler"], []
    fitting = [name for name, sampler in samplers.items() if of_one_kind(sampler, trained)]
    reference = next(pair for pair in REFERENCES if pair[0] in fitting)
    wanted = [(name, count) for name in fitting for count in steps.get(name, ())]
    for name, count in [reference, *(pair for pair in wanted if pair != reference)]:
        tick(f"{name}, {count} steps")
        renderer.model.replace_sampler(samplers[name])
        table.append({"sampler": name, "steps": count} | _row(renderer, scenes, {**settings, "steps": count}, settled))
    return table


def _row(
    renderer: SampleRenderer, scenes: Sequence[SceneBatch], settings: dict[str, Any], settled: list[Tensor]
) -> dict[str, Any]:
    """Measure one sampler; its renders are appended to `settled` if they are the first."""
    measured, times, watch = [], [], Watch(renderer.model)
    for index, scene in enumerate(scenes):
        with watch:
            images = renderer(scene, **settings)[:, 1:]
        times.append(watch.seconds)
        if index == len(settled):
            settled.append(images)
        flat, true = images.flatten(0, 1), scene.targets.images.expand_as(images).flatten(0, 1)
        row = {
            "psnr": psnr(flat, true).mean().item(),
            "ssim": ssim(flat, true).mean().item(),
            "diversity": diversity(images),
            "agreement": psnr(flat, settled[index].flatten(0, 1)).mean().item(),
        }
        measured.append(row)
    return mean_over_scenes(measured) | {"calls": watch.calls, "ms": 1000 * min(times) / renderer.samples}


class Watch:
    """Context that counts denoiser calls and times the computation from the conditioning to the Gaussians."""

    def __init__(self, model: Any) -> None:
        self.model = model
        self.calls, self.seconds = 0, 0.0

    def __enter__(self) -> None:
        self.calls = 0

        def begin(*_: Any) -> None:
            self.start = _now()

        def count(*_: Any) -> None:
            self.calls += 1

        def end(*_: Any) -> None:
            self.seconds = _now() - self.start

        self.hooks = [
            self.model.conditioning.register_forward_pre_hook(begin),
            self.model.denoiser.register_forward_pre_hook(count),
            self.model.autoreconstructor.reconstructor.register_forward_hook(end),
        ]

    def __exit__(self, *_: Any) -> None:
        for hook in self.hooks:
            hook.remove()


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def fewest(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the row with the fewest calls among those whose PSNR is within 0.1 dB of the first, the reference's."""
    close = [row for row in rows if abs(row["psnr"] - rows[0]["psnr"]) <= CLOSE]
    return min(close, key=lambda row: (row["calls"], -row["agreement"]))


PANELS = [
    ("psnr", "PSNR of novel views, dB"),
    ("ssim", "SSIM of novel views"),
    ("agreement", "PSNR against the first row's pictures, dB"),
    ("diversity", "Difference of two samples (RMS)"),
    ("ms", "Time of a sample, ms"),
]
MARKERS = "osD^v"


def plot_samplers(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Write a PNG with a panel for each measure and a line for each sampler; the grey band is ±0.1 dB."""
    from matplotlib.ticker import ScalarFormatter

    with written_figure(path, title, (17, 4)) as figure:
        names = list(dict.fromkeys(row["sampler"] for row in rows))
        for panel, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
            # The reference itself is left out, because its agreement is the limit of PSNR.
            drawn = rows[1:] if key == "agreement" else rows
            for index, name in enumerate(names):
                points = sorted((row["calls"], row[key]) for row in drawn if row["sampler"] == name)
                if points:
                    panel.plot(*zip(*points, strict=True), color=f"C{index}", marker=MARKERS[index % 5], label=name)
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
