"""Benchmark of content that the reference view hides: samples against all possible modes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.errors import CompleteSplatError, DataError
from completesplat.evaluation.mode_predictors import OTHER_SCENE, Predictor, Renders, predictors
from completesplat.evaluation.ply_samples import PlySamples
from completesplat.evaluation.protocol import sampler_settings
from completesplat.evaluation.provenance import provenance
from completesplat.evaluation.records import MODEL
from completesplat.evaluation.scorer import Scorer
from completesplat.evaluation.studies.samples import mean_over_scenes
from completesplat.export.images import Sheet, SheetCell, image_sheet, write_png
from completesplat.files import write_json
from completesplat.metrics.mode_coverage import REJECTED, classify, draw_modes, mean_of, scores
from completesplat.metrics.proper_scores import energy_score
from completesplat.quantities import Natural, Positive, Range
from completesplat.wording import counted


class HiddenModesEvaluation(TypedDict):
    """Numbers of samples, scenes and views. `conf/evaluation/hidden_modes.yaml` explains each."""

    name: str
    board: Mapping[str, Any] | None
    samples: Annotated[int, Range(2)]
    scenes: Positive | None
    views: Positive
    spread_views: Natural
    shown_scenes: Positive
    shown_samples: Positive
    batch: Positive
    seed: Natural


Progress = Callable[[Sequence[HiddenModes]], Iterable[HiddenModes]]
"""Wrapper of the scenes that shows how many have been scored."""

REGIONS = ("hidden", "visible")


@dataclass
class ModeMeasurements:
    """Measurements of the scenes so far, in the views that show the modes.

    `scores` has each scene's `mode_coverage.scores` and energy scores (of pixels that the reference hides, and of the
    others) by method. `classes` has the modes of all samples by method and probabilities. `rows` has the rows of the
    figure. `names` are those of the scenes, and `skipped` has the reasons why other scenes could not be used.
    """

    scores: dict[str, list[dict[str, float | None]]] = field(default_factory=dict)
    classes: dict[str, dict[tuple[float, ...], list[Tensor]]] = field(default_factory=dict)
    rows: Sheet = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

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
        row: list[SheetCell | None] = [SheetCell(scene.scene.reference.images[0], scene.scene.names[0])]
        for mode, name in enumerate(scene.modes):
            row.append(SheetCell(scene.truths[mode, 0], f"{name} (true)" if mode == scene.true_mode else name))
        for sample, mode in enumerate(classify(pixels, modes, scene.probabilities).tolist()):
            row.append(SheetCell(images[sample, 0], "rejected" if mode == REJECTED else scene.modes[mode]))
        self.rows.append(row)

    def results(self, samples: int) -> dict[str, dict[str, float]]:
        """Return means over the scenes by method. An energy score without pixels is 0."""
        results: dict[str, dict[str, float]] = {}
        for method, scene_scores in self.scores.items():
            means = mean_over_scenes(scene_scores)
            results[method] = {name: mean or 0.0 for name, mean in means.items()}
            results[method]["scenes"] = len(self.names)
            results[method]["samples"] = samples
        return results

    def by_scene(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """Return the scores by method and scene."""
        names = self.names
        return {method: dict(zip(names, rows, strict=True)) for method, rows in self.scores.items()}

    def shares(self) -> dict[str, list[dict[str, object]]]:
        """Return by method the modes' shares of samples, over all scenes whose modes have the same probabilities.

        `total_variation` is between the probabilities and these shares (of samples that are not rejected); chance adds
        little to it, because there are many samples. If kinds of scenes differ in their probabilities, it reveals a
        model that has learned how often modes occur, but not when.
        """
        rows: dict[str, list[dict[str, object]]] = {}
        for method, kinds in self.classes.items():
            for probabilities, parts in kinds.items():
                rows.setdefault(method, []).append(_shares(torch.tensor(probabilities), parts))
        return rows


def _shares(probabilities: Float[Tensor, " mode"], classes_by_scene: Sequence[Tensor]) -> dict[str, object]:
    classes = torch.cat(list(classes_by_scene))
    counts = torch.stack([(classes == mode).sum() for mode in range(len(probabilities))])
    shares = counts / counts.sum().clamp(min=1)
    return {
        "probabilities": probabilities.tolist(),
        "scenes": len(classes_by_scene),
        "shares": shares.tolist(),
        "rejected": (classes == REJECTED).float().mean().item(),
        "total_variation": (0.5 * (shares - probabilities).abs().sum()).item() if counts.any() else 1.0,
    }


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
    progress: Progress = iter,
) -> ModeMeasurements:
    """Score all predictors on all scenes. The seed of a scene is that of the scene before it plus one.

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
            if method == MODEL and index < shown_scenes:
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


def score_hidden_modes(
    module: Scorer, data: SceneDataModule, evaluation: HiddenModesEvaluation, progress: Progress = iter
) -> ModeMeasurements:
    """Score a module and the predictors for comparison on the test scenes whose hidden parts are known.

    Raises:
        CompleteSplatError: the data's hidden parts are not known, or no scene can be used.
    """
    samples = evaluation["samples"]
    candidates = data.hidden_modes(evaluation["views"], evaluation["spread_views"])
    scenes, skipped = usable_scenes(candidates, evaluation["scenes"])
    if isinstance(module, PlySamples):
        module.find_files([scene.scene.names[0] for scene in scenes], samples)
    measured = measure(
        predictors(module, samples, evaluation["batch"]),
        [scene.to(module.device) for scene in scenes],
        samples,
        evaluation["seed"],
        evaluation["shown_scenes"],
        evaluation["shown_samples"],
        progress,
    )
    measured.skipped.extend(skipped)
    return measured


def describe_mode_test(
    evaluation: HiddenModesEvaluation, module: Scorer, data: SceneDataModule, measured: ModeMeasurements, out: Path
) -> dict[str, object]:
    """Describe what was measured and how, with results in `out`."""
    described: dict[str, object] = {
        "name": evaluation["name"],
        "samples": evaluation["samples"],
        "views": evaluation["views"],
        "spread_views": evaluation["spread_views"],
        "seed": evaluation["seed"],
        "method": module.method,
    }
    described |= data.describe()
    described["image_size"] = data.image_size
    described |= sampler_settings(module)
    described["scenes"] = measured.names
    described["skipped"] = measured.skipped
    return described | provenance(module, data, out)


def write_modes(measured: ModeMeasurements, samples: int, out: Path) -> None:
    """Write `hidden_modes.json`, `shares.json` and `hidden_modes.png`, which shows `ModeMeasurements.rows`."""
    write_json(out / "hidden_modes.json", measured.results(samples))
    write_json(out / "shares.json", measured.shares())
    title = f"Hidden modes: {counted(len(measured.names), 'scene')}, {samples} samples each. "
    title += "Input; then from behind: every mode, samples with their modes"
    write_png(out / "hidden_modes.png", image_sheet(None, measured.rows, title))
