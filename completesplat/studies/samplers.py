"""Study of samplers and their numbers of steps: quality, diversity, time."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.diffusion.sampling import of_one_kind
from completesplat.generator import CompleteSplat
from completesplat.metrics.images import psnr, ssim
from completesplat.metrics.scoring import diversity
from completesplat.scene import SceneBatch
from completesplat.studies.figures import written_figure
from completesplat.studies.samples import SampleRenderer

REFERENCES = (("ddim", 50), ("flow", 50))  # for a denoiser that predicts noise, and for flow matching
CLOSE = 0.1  # difference in PSNR, in dB, that is ignored


@dataclass(frozen=True)
class SamplerRow:
    """Scores of a sampler with a number of steps: means over samples, views and scenes.

    PSNR and SSIM are of novel views; `agreement` is the PSNR against the reference's renders from the same noise. `ms`
    is the time per sample of the fastest scene, with its reconstruction but without rendering.
    """

    sampler: str
    steps: int
    calls: int
    psnr: float
    ssim: float
    diversity: float
    agreement: float
    ms: float


def rows(
    renderer: SampleRenderer,
    samplers: Mapping[str, Mapping[str, object]],
    steps: Mapping[str, Sequence[int]],
    scenes: Sequence[SceneBatch],
    settings: Mapping[str, float],
    tick: Callable[[str], None],
) -> list[SamplerRow]:
    """Return a row for each fitting sampler and number of steps; the first row is one of `REFERENCES`."""
    settled: list[Float[Tensor, "sample view 3 height width"]] = []
    trained, results = renderer.model.architecture["sampler"], []
    fitting = [name for name, sampler in samplers.items() if of_one_kind(sampler, trained)]
    reference = next(pair for pair in REFERENCES if pair[0] in fitting)
    wanted = [(name, count) for name in fitting for count in steps.get(name, ())]
    for name, count in [reference, *(pair for pair in wanted if pair != reference)]:
        tick(f"{name}, {count} steps")
        renderer.model.replace_sampler(samplers[name])
        results.append(_row(renderer, scenes, name, count, settings, settled))
    return results


def _row(
    renderer: SampleRenderer,
    scenes: Sequence[SceneBatch],
    sampler: str,
    steps: int,
    settings: Mapping[str, float],
    settled: list[Tensor],
) -> SamplerRow:
    """Measure one sampler; its renders are appended to `settled` if they are the first."""
    measured, times, calls = [], [], 0
    for index, scene in enumerate(scenes):
        with denoiser_calls(renderer.model) as counted:
            start = _now()
            gaussians = renderer.generate(scene, **settings, steps=steps)
            times.append(_now() - start)
        calls = len(counted)
        images = renderer.over_background(renderer.rasterize(gaussians, scene))[:, 1:]
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
    means = {key: fmean(row[key] for row in measured) for key in measured[0]}
    return SamplerRow(sampler, steps, calls, **means, ms=1000 * min(times) / renderer.samples)


@contextmanager
def denoiser_calls(model: CompleteSplat) -> Iterator[list[None]]:
    """Yield a list that has an entry for each call of the denoiser in the block."""
    calls: list[None] = []
    hook = model.denoiser.register_forward_pre_hook(lambda *_: calls.append(None))
    try:
        yield calls
    finally:
        hook.remove()


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def fewest(rows: Sequence[SamplerRow]) -> SamplerRow:
    """Return the row with the fewest calls among those whose PSNR is within 0.1 dB of the first, the reference's."""
    close = [row for row in rows if abs(row.psnr - rows[0].psnr) <= CLOSE]
    return min(close, key=lambda row: (row.calls, -row.agreement))


PANELS = [
    ("psnr", "PSNR of novel views, dB"),
    ("ssim", "SSIM of novel views"),
    ("agreement", "PSNR against the first row's images, dB"),
    ("diversity", "Difference of two samples (RMS)"),
    ("ms", "Time of a sample, ms"),
]
MARKERS = "osD^v"


def plot_samplers(rows: Sequence[SamplerRow], path: Path, title: str) -> None:
    """Write a PNG with a panel for each measure and a line for each sampler; the grey band is ±0.1 dB."""
    from matplotlib.ticker import ScalarFormatter

    with written_figure(path, title, (17, 4)) as figure:
        names = list(dict.fromkeys(row.sampler for row in rows))
        for panel, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
            # The reference itself is left out, because its agreement is the limit of PSNR.
            drawn = rows[1:] if key == "agreement" else rows
            for index, name in enumerate(names):
                points = sorted((row.calls, getattr(row, key)) for row in drawn if row.sampler == name)
                if points:
                    panel.plot(*zip(*points, strict=True), color=f"C{index}", marker=MARKERS[index % 5], label=name)
            if key == "psnr":
                panel.axhspan(rows[0].psnr - CLOSE, rows[0].psnr + CLOSE, color="0.85", zorder=0)
            panel.set(xscale="log", xlabel="denoiser calls", title=label)
            panel.set_xticks(sorted({row.calls for row in rows} & {1, 2, 5, 10, 20, 50}))
            panel.xaxis.set_major_formatter(ScalarFormatter())
            panel.xaxis.set_minor_formatter("")
            panel.grid(alpha=0.3)
            if key in ("diversity", "ms"):
                panel.set_ylim(bottom=0)
        figure.axes[0].legend()
