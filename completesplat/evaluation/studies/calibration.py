"""Calibration of samples: ranks of the truth among them, and their spread against the error of their mean.

If the truth and k samples have one distribution, each of the k + 1 ranks of the truth is equally probable, and the mean
square error of the samples' mean is (k + 1) / k times their variance (Fortin et al. 2014).
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.evaluation.regions import novel_values
from completesplat.evaluation.studies.controls import OnProgress, Scenes
from completesplat.evaluation.studies.figures import written_figure
from completesplat.evaluation.studies.samples import SampleRenderer, mean_over_scenes
from completesplat.metrics.proper_scores import SampledValues, TrueValues, crps, energy_score, rank_histogram

BINS = 10

Row = dict[str, Any]


def calibration_rows(renderer: SampleRenderer, scenes: Scenes, tick: OnProgress, **settings: float) -> list[Row]:
    """Return a row for each region of novel views (`novel_values`), with means over the scenes.

    `energy_N` is the energy score of N samples, `below_all` and `above_all` are the ends of the rank histogram `ranks`.
    `spread` and `error` are the roots of the means of `squares`. `bins` has those of the second half of the samples,
    for `BINS` equally large groups of values that are ordered by the variance of the first half. The settings are skip
    and guidance weight (`Sampling`).
    """
    measured = defaultdict[str, list[SceneCalibration]](list)
    for index, scene in enumerate(scenes):
        tick(scene.names[0])
        images = renderer(scene, seed=renderer.seed + index, **settings)[:, 1:]  # new noise for each scene
        for region, (samples, true) in novel_values(images, scene.all_views()[0]).items():
            measured[region].append(measure_scene(samples, true))
    return [_row(region, of_scenes) for region, of_scenes in measured.items()]


class SceneCalibration(NamedTuple):
    """Measurements of one scene: scores by name, shares of ranks, means of `squares`, and `halves`."""

    scores: dict[str, float | None]
    ranks: Float[Tensor, " rank"]
    squares: Float[Tensor, "2"]
    halves: Float[Tensor, "3 value"]


def measure_scene(samples: SampledValues, truth: TrueValues) -> SceneCalibration:
    """Measure the samples of one scene against the truth."""
    scores: dict[str, float | None] = {}
    scores |= energies(samples, truth)
    scores["crps"] = crps(samples, truth)
    means = torch.stack(squares(samples, truth)).double().mean(1)
    return SceneCalibration(scores, rank_histogram(samples, truth), means, halves(samples, truth))


def _row(region: str, scenes: Sequence[SceneCalibration]) -> Row:
    ranks = torch.stack([scene.ranks for scene in scenes]).mean(0).tolist()
    spread, error = torch.stack([scene.squares for scene in scenes]).mean(0).tolist()
    row: Row = {"region": region, "scenes": len(scenes)}
    row |= mean_over_scenes([scene.scores for scene in scenes])
    row["below_all"] = ranks[0]
    row["above_all"] = ranks[-1]
    row["spread"] = spread**0.5
    row["error"] = error**0.5
    row["spread_over_error"] = (spread / error) ** 0.5 if error else None
    row["ranks"] = ranks
    row["bins"] = binned(*torch.cat([scene.halves for scene in scenes], 1))
    return row


def energies(samples: SampledValues, truth: TrueValues) -> dict[str, float]:
    """Return the fair energy scores of 2, 4, 8, ... and all samples: means over disjoint groups of this size."""
    counts = [2**power for power in range(1, len(samples).bit_length())]
    if len(samples) not in counts:
        counts.append(len(samples))
    scores = {}
    for n in counts:
        groups = samples[: len(samples) // n * n].view(-1, n, len(truth))
        scores[f"energy_{n}"] = sum(energy_score(group, truth) for group in groups) / len(groups)
    return scores


def squares(samples: SampledValues, truth: TrueValues) -> tuple[TrueValues, TrueValues]:
    """Return the variance of k samples times (k + 1) / k and the squared error of their mean: ideally equal."""
    variance = samples.var(0) * (len(samples) + 1) / len(samples)
    error = (samples.mean(0) - truth).square()
    return variance, error


def halves(samples: SampledValues, truth: TrueValues) -> Float[Tensor, "3 value"]:
    """Return the variance of the first half of the samples, which orders `bins`, and the `squares` of the second half.

    If the same samples gave both, the lowest bin would hold values whose variance is small by chance, and calibrated
    samples would seem overconfident there. With fewer than four samples the halves overlap.
    """
    half = len(samples) // 2
    return torch.stack([samples[: max(half, 2)].var(0), *squares(samples[min(half, len(samples) - 2) :], truth)])


def binned(order: TrueValues, spreads: TrueValues, errors: TrueValues) -> list[list[float]]:
    """Return root mean spread and error of `BINS` equally large bins of the values, sorted by `order`."""
    values = torch.stack([spreads, errors])[:, order.argsort(stable=True)].double()
    return [part.mean(1).sqrt().tolist() for part in values.tensor_split(min(BINS, len(order)), 1)]


def plot_calibration(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write a PNG with three panels for each region: ranks, spread against error, and energy by number of samples."""
    with written_figure(path, title, (13, 0.5 + 3.7 * len(rows))) as figure:
        panels = figure.subplots(len(rows), 3, squeeze=False)
        for (ranks, bins, energy), row in zip(panels, rows, strict=True):
            name = f"novel views, {row['region']}"
            count = len(row["ranks"])
            end = 1.05 * max(map(max, row["bins"]))
            ranks.bar(range(count), row["ranks"])
            ranks.axhline(1 / count, color="crimson", label="calibrated")
            ranks.set(title=f"{name}: ranks of the truth", xlabel="samples below the truth", ylabel="share of values")
            bins.plot([0, end], [0, end], color="crimson", label="calibrated")
            bins.plot(*zip(*row["bins"], strict=True), "o-", label="bins of equal size")
            bins.set(title=f"{name}: spread and error", xlabel="standard deviation of samples", ylabel="error of mean")
            scores = {int(key[7:]): score for key, score in row.items() if key.startswith("energy_")}
            energy.plot([*scores], [*scores.values()], "o-", label="fair score: should be flat")
            energy.set(title=f"{name}: energy score", xlabel="number of samples", ylim=(0, 1.3 * max(scores.values())))
            for panel in (ranks, bins, energy):
                panel.legend()
                panel.grid(alpha=0.3)
