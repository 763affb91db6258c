"""Benchmark of content that the reference view hides: samples against all possible modes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.errors import CompleteSplatError, DataError
from completesplat.export.images import to_bytes
from completesplat.gaussians import Gaussians
from completesplat.metrics.mode_coverage import (
    EDGES,
    REJECTED,
    HiddenModeScores,
    bin_sums,
    classify,
    curve,
    draw_modes,
    mean_of,
    mean_scores,
    scores,
    spread_and_error,
)
from completesplat.metrics.proper_scores import energy_score
from completesplat.scene import SceneBatch
from completesplat.studies.figures import written_figure
from completesplat.studies.samples import autoreconstructor_of

Renders = Float[Tensor, "sample view 3 height width"]
Predictor = Callable[[SceneBatch, SceneBatch, int], Renders]
"""Function from a scene, another scene (batches of one) and a seed to renders of all targets in [0, 1]."""


def predictors(module: Any, samples: int, batch: int) -> dict[str, Predictor]:
    """Return `model` as it is tested, and simpler predictors, which show where modes are lost.

    A variational autoreconstructor adds `posterior_mean`; `posterior_samples`, with latents drawn from the posterior of
    a scene; and `other_scene`, with latents of another scene but the image and the skips of this one. A posterior that
    sees views takes all targets, so it knows the true mode; `reference_only` is its mean without them. If the
    posterior's samples show the modes and the model's do not, stage 2 is at fault; if neither do, stage 1 is. A
    deterministic model returns `samples` equal renders. Samples are computed and rendered `batch` at a time.
    """

    def model(scene: SceneBatch, other: SceneBatch, seed: int) -> Renders:
        if not module.draws_samples:
            image = _render(module, module.reconstruct(scene, seed=seed), scene)
            return image.expand(samples, *image.shape[1:])
        gaussians = module.reconstruct(scene, seed=seed, samples=samples, batch=batch)
        return torch.cat([_render(module, gaussians[i : i + batch], scene) for i in range(0, samples, batch)])

    network = autoreconstructor_of(module)
    if network is None:
        return {"model": model}
    ladder = _Ladder(module, network, samples, batch)
    methods: dict[str, Predictor] = {
        "model": model,
        "posterior_mean": lambda scene, other, seed: ladder.mean(scene, network.sees_views),
        "posterior_samples": lambda scene, other, seed: ladder.drawn(scene, scene, seed),
        "other_scene": lambda scene, other, seed: ladder.drawn(scene, other, seed),
    }
    if network.sees_views:
        methods["reference_only"] = lambda scene, other, seed: ladder.mean(scene, False)
    return methods


@dataclass(frozen=True)
class _Ladder:
    """Predictors that render an autoreconstructor's output for different latents."""

    module: Any
    model: VariationalAutoReconstructor
    samples: int
    batch: int

    def mean(self, scene: SceneBatch, with_views: bool) -> Renders:
        image = self._rendered(self._posterior(scene, with_views).mean, scene)
        return image.expand(self.samples, *image.shape[1:])

    def drawn(self, scene: SceneBatch, encoded: SceneBatch, seed: int) -> Renders:
        posterior = self._posterior(encoded, self.model.sees_views)
        # On the CPU, so that a seed means the same on every device.
        noise = torch.randn(self.samples, *posterior.mean.shape[1:], generator=torch.Generator().manual_seed(seed))
        latents = posterior.mean + noise.to(posterior.mean) * posterior.std
        return torch.cat([self._rendered(part, scene) for part in torch.split(latents, self.batch)])

    def _posterior(self, scene: SceneBatch, with_views: bool) -> Posterior:
        views = scene.all_views() if with_views else None
        return self.model.posterior(self._seen(scene), views, scene.depth_range)[0]

    def _seen(self, scene: SceneBatch) -> Float[Tensor, "1 3 _ _"]:
        masked = getattr(self.module, "masked", False)
        return scene.reference.images * scene.visible if masked else scene.reference.images

    def _rendered(self, latents: Float[Tensor, "sample channel _ _"], scene: SceneBatch) -> Renders:
        count = len(latents)
        features = self.model.encoder.features(self._seen(scene), self.model.reconstructor.feature_levels)
        splatter_image = self.model.reconstructor(latents, [feature.expand(count, -1, -1, -1) for feature in features])
        cameras = scene.reference.cameras.map(lambda tensor: tensor.expand(count, -1, -1))
        return _render(self.module, splatter_image.gaussians(cameras, scene.depth_range.expand(count, -1)), scene)


def _render(module: Any, gaussians: Gaussians, scene: SceneBatch) -> Renders:
    images: Renders = module.render_from(gaussians, scene.targets.cameras[0]).over(module.background).clamp(0, 1)
    return images


REGIONS = ("hidden", "visible")


@dataclass(frozen=True)
class Shown:
    """Scene for the figure, with samples in the view that shows the modes best, and their classes."""

    scene: HiddenModes
    samples: Float[Tensor, "sample 3 height width"]
    classes: tuple[int, ...]


@dataclass
class Measured:
    """Measurements so far: scores by method and scene, sums of the calibration by method and region.

    `energies` are the energy scores in views that show the modes, of the pixels that the reference hides and of the
    others; `classes` are those of all samples, by method and the modes' probabilities.
    """

    scores: dict[str, list[HiddenModeScores]] = field(default_factory=dict)
    energies: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    sums: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    classes: dict[str, dict[tuple[float, ...], list[Tensor]]] = field(default_factory=dict)
    shown: list[Shown] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def add(self, method: str, images: Renders, scene: HiddenModes) -> None:
        """Add the scores of renders of the views that show the modes."""
        pixels, modes = in_region(images, scene.region), in_region(scene.truths, scene.region)
        self.scores.setdefault(method, []).append(scores(pixels, modes, scene.probabilities))
        alike = self.classes.setdefault(method, {}).setdefault(tuple(scene.probabilities.tolist()), [])
        alike.append(classify(pixels, modes, scene.probabilities))
        unseen, truth = scene.unseen[list(scene.views)], scene.truths[scene.true_mode]
        energies = self.energies.setdefault(method, {name: [] for name in REGIONS})
        for name, region in zip(REGIONS, (unseen, ~unseen), strict=True):
            if region.any():
                true = in_region(truth[None], region)[0].flatten()
                energies[name].append(energy_score(in_region(images, region).flatten(1), true))

    def add_calibration(self, method: str, renders: Renders, scene: HiddenModes) -> None:
        """Add the calibration of renders of all targets."""
        variance, error = spread_and_error(renders, scene.scene.targets.images[0])
        sums = self.sums.setdefault(method, {})
        for name, region in zip(REGIONS, (scene.unseen, ~scene.unseen), strict=True):
            sums[name] = sums.get(name, 0) + bin_sums(variance, error, region)

    def show(self, images: Renders, scene: HiddenModes, count: int) -> None:
        """Keep images and classes of some samples."""
        pixels, modes = in_region(images[:count], scene.region), in_region(scene.truths, scene.region)
        classes = classify(pixels, modes, scene.probabilities)
        self.shown.append(Shown(scene, images[:count, 0], tuple(classes.tolist())))

    def results(self, samples: int) -> dict[str, dict[str, float]]:
        """Return means over the scenes by method."""
        counts = {"scenes": len(self.names), "samples": samples}
        return {
            method: asdict(mean_scores(scene_scores))
            | {f"energy_{name}": sum(values) / max(1, len(values)) for name, values in self.energies[method].items()}
            | counts
            for method, scene_scores in self.scores.items()
        }

    def shares(self) -> dict[str, list[dict[str, Any]]]:
        """Return by method the modes' shares of samples, over all scenes whose modes have the same probabilities.

        `total_variation` is between the probabilities and these shares (of samples that are not rejected); chance adds
        little to it, because there are many samples. If kinds of scenes differ in their probabilities, it reveals a
        model that has learned how often modes occur, but not when.
        """
        rows: dict[str, list[dict[str, Any]]] = {}
        for method, kinds in self.classes.items():
            for probabilities, each in kinds.items():
                classes, p = torch.cat(each), torch.tensor(probabilities)
                counts = torch.stack([(classes == mode).sum() for mode in range(len(p))])
                shares = counts / counts.sum().clamp(min=1)
                row = {"probabilities": p.tolist(), "scenes": len(each), "shares": shares.tolist()}
                row["rejected"] = (classes == REJECTED).float().mean().item()
                row["total_variation"] = (0.5 * (shares - p).abs().sum()).item() if counts.any() else 1.0
                rows.setdefault(method, []).append(row)
        return rows

    def calibration(self) -> dict[str, dict[str, Any]]:
        """Return calibration curves by method and region."""
        return {method: {region: curve(sums) for region, sums in parts.items()} for method, parts in self.sums.items()}


def in_region(
    images: Float[Tensor, "_ view 3 height width"], region: Bool[Tensor, "view height width"]
) -> Float[Tensor, "_ pixel 3"]:
    """Return the region's pixels of all views in one row."""
    return images.movedim(2, -1)[:, region]


@torch.no_grad()
def measure(
    predictors: Mapping[str, Predictor],
    scenes: Sequence[HiddenModes],
    samples: int,
    seed: int,
    shown_scenes: int,
    shown_samples: int,
    progress: Callable[[Sequence[HiddenModes]], Iterable[HiddenModes]] = iter,
) -> Measured:
    """Score all predictors on all scenes; the seed of a scene is that of the scene before it plus one.

    Two predictors that know all modes are added: `true_sampler` draws by their probabilities, `mean_predictor` repeats
    their mean. The other scene for a predictor is the previous one (for the first, the last). The figure shows samples
    of `model`.
    """
    measured = Measured()
    for index, scene in enumerate(progress(scenes)):
        mean = mean_of(scene.truths, scene.probabilities)
        measured.add("true_sampler", draw_modes(scene.truths, scene.probabilities, samples, seed + index), scene)
        measured.add("mean_predictor", mean.expand(samples, *mean.shape), scene)
        for method, predict in predictors.items():
            renders = predict(scene.scene, scenes[index - 1].scene, seed + index)
            mode_views = renders[:, list(scene.views)]
            measured.add(method, mode_views, scene)
            measured.add_calibration(method, renders, scene)
            if method == "model" and index < shown_scenes:
                measured.show(mode_views, scene, shown_samples)
        measured.names.append(scene.scene.names[0])
    return measured


def usable(scenes: HiddenModeScenes, count: int | None) -> tuple[list[HiddenModes], list[str]]:
    """Return the usable ones of the first `count` scenes (None: all), and the reasons why others are not."""
    selected, skipped = [], []
    for index in range(len(scenes) if count is None else min(count, len(scenes))):
        try:
            selected.append(scenes[index])
        except DataError as error:
            skipped.append(str(error))
    if not selected:
        reason = skipped[0] if skipped else "there are none"
        raise CompleteSplatError(f"no test scene can be used for hidden modes; the first: {reason}")
    return selected, skipped


SIDE, GAP, CHARTS = 1.0, 0.06, 10.0
"""Side of an image, space between images and width of the charts, in inches."""
BEST = {"coverage": 1, "total_variation": 0, "sharpness": 0, "rejected": 0}
COLORS = {"hidden": "C3", "visible": "C0"}
STYLES = ("o-", "s--", "^:", "v-.", "d-")
LOWEST = EDGES[0].item() / 2  # where variances and errors below the first edge are drawn


def draw(
    shown: Sequence[Shown],
    results: Mapping[str, Mapping[str, float]],
    calibration: Mapping[str, Mapping[str, Any]],
    samples: int,
    path: Path,
) -> None:
    """Write a PNG: a row of images for each scene, and beside them the scores and the calibration by method."""
    count = 1 + len(shown[0].scene.modes) + len(shown[0].samples)
    height = max(5.4, (SIDE + 0.3) * len(shown) + 0.8)
    width = (SIDE + GAP) * count + 0.3 + CHARTS
    split, top = 1 - CHARTS / width, 1 - 0.7 / height
    bottom = max(0.1, height - 0.7 - (SIDE + 0.3) * len(shown)) / height
    places = {"left": 0.3 / width, "right": split, "top": top, "bottom": bottom}
    first = next(iter(results.values()))
    title = f"Hidden modes: {first['scenes']} scenes, {first['samples']} samples each"
    title += ". Input; then from behind: every mode, the true one in green; samples with the mode found"
    # Laid out by hand, because matplotlib's constrained layout takes seconds for this many panels.
    with written_figure(path, title, (width, height), layout=None) as figure:
        grid = figure.add_gridspec(len(shown), count, **places, wspace=GAP / SIDE, hspace=0.3 / SIDE)
        _draw_pictures(grid.subplots(squeeze=False), shown)
        charts = {"left": split + 0.6 / width, "right": 1 - 0.2 / width, "top": top, "bottom": 1.4 / height}
        panels: Any = figure.add_gridspec(1, 2, **charts, wspace=0.22).subplots()
        bars, curves = panels
        _draw_bars(bars, results)
        _draw_calibration(curves, calibration, samples)


def _draw_pictures(rows: Any, shown: Sequence[Shown]) -> None:
    for panels, row in zip(rows, shown, strict=True):
        scene = row.scene
        panels[0].set_ylabel(scene.scene.names[0], fontsize=7)
        labels = [("input", "k")]
        labels += [(name, "g" if mode == scene.true_mode else "k") for mode, name in enumerate(scene.modes)]
        labels += [("rejected", "0.5") if n == REJECTED else (scene.modes[n], "C1") for n in row.classes]
        images = [scene.scene.reference.images[0], *scene.truths[:, 0], *row.samples]
        for panel, image, (label, color) in zip(panels, images, labels, strict=True):
            panel.imshow(to_bytes(image), interpolation="nearest")
            panel.set(xticks=[], yticks=[])
            panel.set_title(label, fontsize=8, color=color, pad=2)
            panel.spines[:].set(color=color, linewidth=0.6 if color == "k" else 2)


def _draw_bars(panel: Any, results: Mapping[str, Mapping[str, float]]) -> None:
    width = 0.8 / len(results)
    for index, (method, entry) in enumerate(results.items()):
        places = [place + (index + 0.5) * width - 0.4 for place in range(len(BEST))]
        bars = panel.bar(places, [entry[key] for key in BEST], width, label=method.replace("_", " "), color=f"C{index}")
        panel.bar_label(bars, fmt="%.2f", fontsize=7, padding=1)
    labels = [f"{key.replace('_', ' ')}\n(best: {best})" for key, best in BEST.items()]
    panel.set_xticks(range(len(BEST)), labels, fontsize=8)
    panel.axhline(1, color="0.8", linewidth=0.8, zorder=0)
    panel.margins(y=0.12)
    panel.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)


def _draw_calibration(panel: Any, calibration: Mapping[str, Mapping[str, Any]], samples: int) -> None:
    for style, (method, by_region) in zip(STYLES, calibration.items(), strict=False):
        for region in REGIONS:
            bins = by_region[region]["bins"]
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
