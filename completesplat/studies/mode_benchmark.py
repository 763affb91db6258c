"""Benchmark of content that the reference view hides: samples against all possible modes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.errors import CompleteSplatError, DataError
from completesplat.export.images import SheetCell, image_sheet, write_png
from completesplat.gaussians import Gaussians
from completesplat.metrics.mode_coverage import (
    REJECTED,
    HiddenModeScores,
    classify,
    draw_modes,
    mean_of,
    mean_scores,
    scores,
)
from completesplat.metrics.proper_scores import energy_score
from completesplat.scene import SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.stage import Stage

Renders = Float[Tensor, "sample view 3 height width"]
Predictor = Callable[[SceneBatch, SceneBatch, int], Renders]
"""Function from a scene, another scene (batches of one) and a seed to renders of all targets in [0, 1]."""


def predictors(module: Stage, samples: int, batch: int) -> dict[str, Predictor]:
    """Return `model` as it is tested, and simpler predictors, which show where modes are lost.

    A variational autoreconstructor adds `posterior_mean`; `posterior_samples`, with latents drawn from the posterior of
    a scene; and `other_scene`, with latents of another scene but the image and the skips of this one. A posterior that
    sees views takes all targets, so it knows the true mode; `reference_only` is its mean without them. If the
    posterior's samples show the modes and the model's do not, stage 2 is at fault; if neither do, stage 1 is. A
    deterministic model returns `samples` equal renders. Samples are computed and rendered `batch` at a time.
    """

    def model(scene: SceneBatch, other: SceneBatch, seed: int) -> Renders:
        sets = module.draw(scene, [seed], samples, batch)
        images = torch.cat([_render(module, sets[i : i + batch], scene) for i in range(0, len(sets.means), batch)])
        return images.expand(samples, *images.shape[1:])

    frozen = module.completesplat.autoreconstructor if isinstance(module, LatentDiffusion) else None
    network = frozen or getattr(module, "model", None)
    if not isinstance(network, VariationalAutoReconstructor):
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

    module: Stage
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
        features = self.model.encoder.features(self._seen(scene) * 2 - 1, self.model.reconstructor.feature_levels)
        splatter_image = self.model.reconstructor(latents, [feature.expand(count, -1, -1, -1) for feature in features])
        cameras = scene.reference.cameras.map(lambda tensor: tensor.expand(count, -1, -1))
        return _render(self.module, splatter_image.gaussians(cameras, scene.depth_range.expand(count, -1)), scene)


def _render(module: Stage, gaussians: Gaussians, scene: SceneBatch) -> Renders:
    images: Renders = module.render_from(gaussians, scene.targets.cameras[0]).over(module.background).clamp(0, 1)
    return images


REGIONS = ("hidden", "visible")


@dataclass
class Measured:
    """Measurements so far: scores by method and scene.

    `energies` are the energy scores in views that show the modes, of the pixels that the reference hides and of the
    others; `classes` are those of all samples, by method and the modes' probabilities; `rows` are those of the figure.
    """

    scores: dict[str, list[HiddenModeScores]] = field(default_factory=dict)
    energies: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    classes: dict[str, dict[tuple[float, ...], list[Tensor]]] = field(default_factory=dict)
    rows: list[list[SheetCell]] = field(default_factory=list)
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

    def show(self, images: Renders, scene: HiddenModes, count: int) -> None:
        """Keep the input, every mode, and some samples with their modes, in the view that shows the modes best."""
        pixels, modes = in_region(images[:count], scene.region), in_region(scene.truths, scene.region)
        labels = [f"{name} (true)" if mode == scene.true_mode else name for mode, name in enumerate(scene.modes)]
        classes = classify(pixels, modes, scene.probabilities).tolist()
        labels += ["rejected" if mode == REJECTED else scene.modes[mode] for mode in classes]
        cells = [SheetCell(scene.scene.reference.images[0], scene.scene.names[0])]
        cells += [SheetCell(*cell) for cell in zip([*scene.truths[:, 0], *images[:count, 0]], labels, strict=True)]
        self.rows.append(cells)

    def results(self, samples: int) -> dict[str, dict[str, float]]:
        """Return means over the scenes by method."""
        counts = {"scenes": len(self.names), "samples": samples}
        return {
            method: asdict(mean_scores(scene_scores))
            | {f"energy_{name}": sum(values) / max(1, len(values)) for name, values in self.energies[method].items()}
            | counts
            for method, scene_scores in self.scores.items()
        }

    def shares(self) -> dict[str, list[dict[str, object]]]:
        """Return by method the modes' shares of samples, over all scenes whose modes have the same probabilities.

        `total_variation` is between the probabilities and these shares (of samples that are not rejected); chance adds
        little to it, because there are many samples. If kinds of scenes differ in their probabilities, it reveals a
        model that has learned how often modes occur, but not when.
        """
        rows: dict[str, list[dict[str, object]]] = {}
        for method, kinds in self.classes.items():
            for probabilities, each in kinds.items():
                classes, p = torch.cat(each), torch.tensor(probabilities)
                counts = torch.stack([(classes == mode).sum() for mode in range(len(p))])
                shares = counts / counts.sum().clamp(min=1)
                row = {
                    "probabilities": p.tolist(),
                    "scenes": len(each),
                    "shares": shares.tolist(),
                    "rejected": (classes == REJECTED).float().mean().item(),
                    "total_variation": (0.5 * (shares - p).abs().sum()).item() if counts.any() else 1.0,
                }
                rows.setdefault(method, []).append(row)
        return rows


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


def draw(measured: Measured, samples: int, path: Path) -> None:
    """Write a PNG with a row for each scene of `Measured.rows`."""
    title = f"Hidden modes: {len(measured.names)} scenes, {samples} samples each. Input; then from behind: every mode, "
    headings = [""] * max(map(len, measured.rows))
    write_png(path, image_sheet(headings, measured.rows, f"{title}samples with their modes"))
