"""Benchmark of content that the reference view hides: samples against all possible modes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.autoreconstructor.encoder import Features
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.loading.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.diffusion.sampling import in_parts
from completesplat.errors import CompleteSplatError, DataError
from completesplat.export.images import Sheet, SheetCell, image_sheet, write_png
from completesplat.files import counted
from completesplat.gaussians import Gaussians
from completesplat.metrics.mode_coverage import REJECTED, classify, draw_modes, mean_of, scores
from completesplat.metrics.proper_scores import energy_score
from completesplat.scene import SceneBatch
from completesplat.splatter_image import SplatterImage
from completesplat.studies.samples import mean_over_scenes
from completesplat.tensors import concatenate
from completesplat.training.latent_diffusion import DiffusionScorer
from completesplat.training.scoring import Scorer

OTHER_SCENE = "other_scene"
Renders = Float[Tensor, "sample view 3 height width"]
Predictor = Callable[[SceneBatch, SceneBatch, int], Renders]
"""Function from a scene, another scene (batches of one) and a seed to renders of all targets in [0, 1]."""

Method = Callable[[SceneBatch, SceneBatch, int], Gaussians]
"""Function from the same arguments to Gaussians [sample], or [1] if it draws nothing."""


def decoding_methods(
    model: VariationalAutoReconstructor, samples: int, batch: int, masked: bool = False
) -> dict[str, Method]:
    """Return, by name, functions that decode different latents with the skips of the scene's image.

    `posterior_mean` and `posterior_samples` take latents from the scene's posterior, `other_scene` from another
    scene's. A posterior that sees views takes all targets; `reference_only` is its mean without them.

    Args:
        batch: number of latents that are decoded at a time.
        masked: whether the model sees only the visible part of the reference image.
    """

    def encode(scene: SceneBatch, with_views: bool = model.sees_views) -> tuple[Posterior, Features]:
        image = scene.reference.images * scene.visible if masked else scene.reference.images
        return model.posterior(image, scene.all_views() if with_views else None, scene.depth_range)

    def decode(latents: Float[Tensor, "sample channel _ _"], scene: SceneBatch) -> Gaussians:
        _, features = encode(scene, False)

        def decode_part(part: slice) -> Gaussians:
            count = len(latents[part])
            skips = [feature.expand(count, -1, -1, -1) for feature in features]
            cameras = scene.reference.cameras[0].repeated(count)
            splatter_image: SplatterImage = model.reconstructor(latents[part], skips)
            return splatter_image.gaussians(cameras, scene.depth_range.expand(count, -1))

        return concatenate(in_parts(decode_part, len(latents), batch))

    def decode_samples(scene: SceneBatch, encoded: SceneBatch, seed: int) -> Gaussians:
        q, _ = encode(encoded)
        # On the CPU, so that a seed means the same on every device.
        noise = torch.randn(samples, *q.mean.shape[1:], generator=torch.Generator().manual_seed(seed))
        return decode(q.mean + noise.to(q.mean) * q.std, scene)

    methods: dict[str, Method] = {
        "posterior_mean": lambda scene, other, seed: decode(encode(scene)[0].mean, scene),
        "posterior_samples": lambda scene, other, seed: decode_samples(scene, scene, seed),
        OTHER_SCENE: lambda scene, other, seed: decode_samples(scene, other, seed),
    }
    if model.sees_views:
        methods["reference_only"] = lambda scene, other, seed: decode(encode(scene, False)[0].mean, scene)
    return methods


def predictors(module: Scorer, samples: int, batch: int) -> dict[str, Predictor]:
    """Return `model` as it is tested, and its autoreconstructor's `decoding_methods`, which show where modes are lost.

    A posterior that sees views knows the true mode. If the posterior's samples show the modes and the model's do not,
    stage 2 is at fault; if neither do, stage 1 is. A deterministic method returns `samples` equal renders. Samples are
    computed and rendered `batch` at a time.
    """
    methods: dict[str, Method] = {"model": lambda scene, other, seed: module.draw(scene, [seed], samples, batch)}
    frozen = module.completesplat.autoreconstructor if isinstance(module, DiffusionScorer) else None
    network = frozen or getattr(module, "model", None)
    if isinstance(network, VariationalAutoReconstructor):
        methods |= decoding_methods(network, samples, batch, getattr(module, "masked", False))

    def render(method: Method, scene: SceneBatch, other: SceneBatch, seed: int) -> Renders:
        gaussians = method(scene, other, seed)
        cameras = scene.targets.cameras[0]
        parts = [gaussians[i : i + batch] for i in range(0, len(gaussians.means), batch)]
        renders = torch.cat([module.render_from(part, cameras).over(module.background) for part in parts])
        return renders.clamp(0, 1).expand(samples, -1, -1, -1, -1)

    return {name: partial(render, method) for name, method in methods.items()}


REGIONS = ("hidden", "visible")


@dataclass
class ModeMeasurements:
    """Measurements of the scenes so far, in the views that show the modes.

    `scores` has each scene's `mode_coverage.scores` and energy scores (of pixels that the reference hides, and of the
    others) by method, `classes` the modes of all samples by method and probabilities, `rows` the rows of the figure.
    """

    scores: dict[str, list[dict[str, float | None]]] = field(default_factory=dict)
    classes: dict[str, dict[tuple[float, ...], list[Tensor]]] = field(default_factory=dict)
    rows: Sheet = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def add(self, method: str, images: Renders, scene: HiddenModes) -> None:
        """Add the scores of renders of the views that show the modes."""
        pixels = region_pixels(images, scene.region)
        modes = region_pixels(scene.truths, scene.region)
        figures: dict[str, float | None] = dict(scores(pixels, modes, scene.probabilities))
        alike = self.classes.setdefault(method, {}).setdefault(tuple(scene.probabilities.tolist()), [])
        alike.append(classify(pixels, modes, scene.probabilities))
        unseen = scene.unseen[list(scene.views)]
        truth = scene.truths[scene.true_mode]
        for name, region in zip(REGIONS, (unseen, ~unseen), strict=True):
            drawn = region_pixels(images, region).flatten(1)
            true = region_pixels(truth[None], region)[0].flatten()
            figures[f"energy_{name}"] = energy_score(drawn, true) if region.any() else None
        self.scores.setdefault(method, []).append(figures)

    def show(self, images: Renders, scene: HiddenModes, count: int) -> None:
        """Keep the input, every mode, and some samples with their modes, in the view that shows the modes best."""
        pixels = region_pixels(images[:count], scene.region)
        modes = region_pixels(scene.truths, scene.region)
        labels = [f"{name} (true)" if mode == scene.true_mode else name for mode, name in enumerate(scene.modes)]
        classes = classify(pixels, modes, scene.probabilities).tolist()
        labels += ["rejected" if mode == REJECTED else scene.modes[mode] for mode in classes]
        row = [scene.scene.reference.images[0], *scene.truths[:, 0], *images[:count, 0]]
        self.rows.append([SheetCell(*cell) for cell in zip(row, [scene.scene.names[0], *labels], strict=True)])

    def results(self, samples: int) -> dict[str, dict[str, float]]:
        """Return means over the scenes by method; an energy score without pixels is 0."""
        counts = {"scenes": len(self.names), "samples": samples}
        means = {method: mean_over_scenes(scene_scores) for method, scene_scores in self.scores.items()}
        return {method: {name: x or 0.0 for name, x in values.items()} | counts for method, values in means.items()}

    def shares(self) -> dict[str, list[dict[str, object]]]:
        """Return by method the modes' shares of samples, over all scenes whose modes have the same probabilities.

        `total_variation` is between the probabilities and these shares (of samples that are not rejected); chance adds
        little to it, because there are many samples. If kinds of scenes differ in their probabilities, it reveals a
        model that has learned how often modes occur, but not when.
        """
        rows: dict[str, list[dict[str, object]]] = {}
        for method, kinds in self.classes.items():
            for probabilities, parts in kinds.items():
                classes = torch.cat(parts)
                p = torch.tensor(probabilities)
                counts = torch.stack([(classes == mode).sum() for mode in range(len(p))])
                shares = counts / counts.sum().clamp(min=1)
                row = {
                    "probabilities": p.tolist(),
                    "scenes": len(parts),
                    "shares": shares.tolist(),
                    "rejected": (classes == REJECTED).float().mean().item(),
                    "total_variation": (0.5 * (shares - p).abs().sum()).item() if counts.any() else 1.0,
                }
                rows.setdefault(method, []).append(row)
        return rows


def region_pixels(images: Renders, region: Bool[Tensor, "view height width"]) -> Float[Tensor, "sample pixel 3"]:
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
) -> ModeMeasurements:
    """Score all predictors on all scenes; the seed of a scene is that of the scene before it plus one.

    Two predictors that know all modes are added: `true_sampler` draws by their probabilities, `mean_predictor` repeats
    their mean. The other scene for a predictor is the previous one (for the first, the last). The figure shows `model`.
    """
    measured = ModeMeasurements()
    for index, scene in enumerate(progress(scenes)):
        mean = mean_of(scene.truths, scene.probabilities)
        measured.add("true_sampler", draw_modes(scene.truths, scene.probabilities, samples, seed + index), scene)
        measured.add("mean_predictor", mean.expand(samples, *mean.shape), scene)
        for method, predict in predictors.items():
            if method == OTHER_SCENE and len(scenes) == 1:
                continue
            renders = predict(scene.scene, scenes[index - 1].scene, seed + index)
            mode_views = renders[:, list(scene.views)]
            measured.add(method, mode_views, scene)
            if method == "model" and index < shown_scenes:
                measured.show(mode_views, scene, shown_samples)
        measured.names.append(scene.scene.names[0])
    return measured


def usable_scenes(scenes: HiddenModeScenes, count: int | None) -> tuple[list[HiddenModes], list[str]]:
    """Return the usable ones of the first `count` scenes (None: all), and the reasons why others are not."""
    selected = []
    skipped = []
    for index in range(len(scenes) if count is None else min(count, len(scenes))):
        try:
            selected.append(scenes[index])
        except DataError as error:
            skipped.append(str(error))
    if not selected:
        reason = skipped[0] if skipped else "there are none"
        raise CompleteSplatError(f"no test scene can be used for hidden modes; the first: {reason}")
    return selected, skipped


def write_modes(measured: ModeMeasurements, samples: int, path: Path) -> None:
    """Write a PNG with a row for each scene of `ModeMeasurements.rows`."""
    title = f"Hidden modes: {counted(len(measured.names), 'scene')}, {samples} samples each. Input; then from behind: "
    write_png(path, image_sheet(None, measured.rows, f"{title}every mode, samples with their modes"))
