"""Effects of the controls of sampling: skip and guidance weight."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from matplotlib import colormaps

from completesplat.evaluation.studies.figures import written_figure
from completesplat.evaluation.studies.samples import (
    SampleRenderer,
    farthest,
    mean_over_scenes,
    near_reference,
    object_psnr,
)
from completesplat.export.images import Sheet, strip
from completesplat.metrics.images import psnr
from completesplat.metrics.sample_scores import diversity
from completesplat.scene import SceneBatch

WeightPairs = Sequence[tuple[float, float]]  # skip and guidance weights
Scenes = Sequence[SceneBatch]  # batches of one
Row = dict[str, float | None]
OnProgress = Callable[[str], None]
Measure = Callable[[SceneBatch, float, float], Mapping[str, float | None]]

# From faithful to diverse (supplement, "Diverse Sampling").
PAPER = ((1.0, 0.2), (0.5, 0.5), (0.0, 0.5))


def grid(skip_weights: Sequence[float], guidance_weights: Sequence[float]) -> list[tuple[float, float]]:
    """Return all pairs of (skip weight, guidance weight) and the paper's three."""
    return sorted({*product(map(float, skip_weights), map(float, guidance_weights)), *PAPER})


def controls_rows(
    renderer: SampleRenderer, settings: WeightPairs, scenes: Scenes, near_degrees: float, tick: OnProgress
) -> list[Row]:
    """Return a row for each setting, with means over the scenes.

    `reference_psnr` is of the reference view. `near_object_psnr` is of the true object's pixels in targets at most
    `near_degrees` from the reference's direction, which mostly show surfaces of the input. `diversity` is of targets.
    """

    def measure(scene: SceneBatch, skip_weight: float, guidance_weight: float) -> Row:
        images = renderer(scene, skip_weight=skip_weight, guidance_weight=guidance_weight)
        reference = scene.reference
        targets = scene.targets[0]
        near = near_reference(reference.cameras[0], targets.cameras, near_degrees)
        return {
            "reference_psnr": psnr(images[:, 0], reference.images.expand_as(images[:, 0])).mean().item(),
            "near_object_psnr": object_psnr(images[:, 1:][:, near], targets.images[near], targets.masks[near]),
            "diversity": diversity(images[:, 1:]),
        }

    return over_settings(settings, scenes, measure, tick)


def over_settings(settings: WeightPairs, scenes: Scenes, measure: Measure, tick: OnProgress) -> list[Row]:
    """Return a row for each setting: means over the scenes, measured with its skip and guidance weight."""
    results: list[Row] = []
    for skip_weight, guidance_weight in settings:
        tick(f"skip weight {skip_weight:g}, guidance weight {guidance_weight:g}")
        means = mean_over_scenes([measure(scene, skip_weight, guidance_weight) for scene in scenes])
        paper = (skip_weight, guidance_weight) in PAPER
        results.append({"skip_weight": skip_weight, "guidance_weight": guidance_weight, "paper": paper, **means})
    return results


def controls_strips(renderer: SampleRenderer, settings: WeightPairs, scene: SceneBatch, samples: int) -> Sheet:
    """Return rows by skip weight and columns by guidance weight: one sample's reference view, several far views.

    The far view is the target whose direction differs most from the reference's. The first row is the truth.
    """
    far = farthest(scene)
    skips = sorted({skip for skip, _ in settings})
    weights = sorted({weight for _, weight in settings})
    rows = [strip(scene.all_views().images[0, [0, far]], "truth: reference, far")]
    for skip in skips[::-1]:
        rows.append([])
        for weight in weights:
            if (skip, weight) not in settings:
                rows[-1] += [None] * (1 + samples)
                continue
            images = renderer(scene, skip_weight=skip, guidance_weight=weight)
            label = f"skip {skip:g}, guidance {weight:g}"
            if (skip, weight) in PAPER:
                label = f"paper: {label}"
            rows[-1] += strip(torch.cat([images[:1, 0], images[:samples, far]]), label, 1 + samples)
    return rows


PANELS = {"reference_psnr": "Reference view: PSNR, dB", "near_object_psnr": "Object in near views: PSNR, dB"}


def plot_controls(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Write a PNG with a panel for each measure of faithfulness. The paper's three settings are circled and named."""
    with written_figure(path, title, (13, 5.5)) as figure:
        skips = sorted({row["skip_weight"] for row in rows})
        for panel, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
            drawn = [row for row in rows if row[key] is not None]
            for skip in skips:
                line = sorted((r["guidance_weight"], r["diversity"], r[key]) for r in drawn if r["skip_weight"] == skip)
                color = colormaps["viridis"](0.9 * skip)
                panel.plot([p[1] for p in line], [p[2] for p in line], "o-", color=color, label=f"skip weight {skip:g}")
                for weight, x, y in line:
                    panel.annotate(f"{weight:g}", (x, y), (4, -9), textcoords="offset points", fontsize=7, color="0.35")
            for row in drawn:
                if row["paper"]:
                    place = (row["diversity"], row[key])
                    name = f"({row['skip_weight']:g}, {row['guidance_weight']:g})"
                    panel.plot(*place, "o", markersize=13, fillstyle="none", color="crimson")
                    panel.annotate(name, place, (9, 9), textcoords="offset points", color="crimson")
            panel.set(xlabel="diversity: difference of two samples in novel views (RMS)", ylabel=label)
            panel.grid(alpha=0.3)
            panel.margins(0.12)
        figure.axes[0].legend(title="along a curve: guidance weight")
