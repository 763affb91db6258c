"""Scores, calibration and pictures of all predictors, over all scenes."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.errors import CompleteSplatError, DataError
from completesplat.metrics.calibration import bin_sums, curve, spread_and_error
from completesplat.metrics.hidden_modes import HiddenModeScores, classify, draw_modes, mean_of, mean_scores, scores
from completesplat.reports.hidden_modes.predictors import Predictor

REGIONS = ("hidden", "visible")


@dataclass(frozen=True)
class Shown:
    """A scene's pictures for the figure, from the view that shows the modes best, and the samples' classes."""

    name: str
    reference: Float[Tensor, "3 height width"]
    truths: Float[Tensor, "mode 3 height width"]
    modes: tuple[str, ...]
    true_mode: int
    samples: Float[Tensor, "sample 3 height width"]
    classes: tuple[int, ...]


@dataclass
class Measured:
    """What was found so far: scores by method and scene, sums of the calibration by method and region."""

    scores: dict[str, list[HiddenModeScores]] = field(default_factory=dict)
    sums: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    shown: dict[str, list[Shown]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def results(self, samples: int) -> dict[str, dict[str, float]]:
        """Means over the scenes by method."""
        counts = {"scenes": len(self.names), "samples": samples}
        return {method: asdict(mean_scores(found)) | counts for method, found in self.scores.items()}

    def calibration(self) -> dict[str, dict[str, Any]]:
        """Curves by method and region."""
        return {method: {region: curve(sums) for region, sums in found.items()} for method, found in self.sums.items()}


def in_region(
    images: Float[Tensor, "_ view 3 height width"], region: Bool[Tensor, "view height width"]
) -> Float[Tensor, "_ pixel 3"]:
    """The region's pixels, those of all views in one row."""
    return images.movedim(2, -1)[:, region]


@torch.no_grad()
def measure(
    predictors: Mapping[str, Predictor],
    scenes: Iterator[HiddenModes | DataError],
    samples: int,
    seed: int,
    shown_scenes: int,
    shown_samples: int,
) -> Measured:
    """Every scene has the seed after that of the last one.

    Raises:
        CompleteSplatError: no scene can be used.
    """
    measured = Measured()
    for index, scene in enumerate(scenes):
        if isinstance(scene, DataError):
            measured.skipped.append(str(scene))
            continue
        _measure_naive(measured, scene, samples, seed + index)
        for method, predict in predictors.items():
            renders = predict(scene.scene, seed + index)
            own = renders[:, list(scene.views)]
            _add(measured, method, own, scene)
            _add_calibration(measured, method, renders, scene)
            if len(measured.names) < shown_scenes:
                measured.shown.setdefault(method, []).append(_shown(scene, own, shown_samples))
        measured.names.append(scene.scene.names[0])
    if not measured.names:
        reason = measured.skipped[0] if measured.skipped else "there are none"
        raise CompleteSplatError(f"no test scene can be used for hidden modes; the first: {reason}")
    return measured


def _measure_naive(measured: Measured, scene: HiddenModes, samples: int, seed: int) -> None:
    """What knows all modes: their mean, as often as there are samples, and draws by their probabilities."""
    mean = mean_of(scene.truths, scene.probabilities)
    _add(measured, "true_sampler", draw_modes(scene.truths, scene.probabilities, samples, seed), scene)
    _add(measured, "mean_predictor", mean.expand(samples, *mean.shape), scene)


def _add(measured: Measured, method: str, images: Float[Tensor, "_ view 3 height width"], scene: HiddenModes) -> None:
    found = scores(in_region(images, scene.region), in_region(scene.truths, scene.region), scene.probabilities)
    measured.scores.setdefault(method, []).append(found)


def _add_calibration(
    measured: Measured, method: str, renders: Float[Tensor, "_ view 3 height width"], scene: HiddenModes
) -> None:
    variance, error = spread_and_error(renders, scene.scene.targets.images[0])
    found = measured.sums.setdefault(method, {})
    for name, region in zip(REGIONS, (scene.unseen, ~scene.unseen), strict=True):
        sums = bin_sums(variance, error, region)
        found[name] = found[name] + sums if name in found else sums


def _shown(scene: HiddenModes, images: Float[Tensor, "_ view 3 height width"], count: int) -> Shown:
    classes = classify(in_region(images, scene.region), in_region(scene.truths, scene.region), scene.probabilities)
    return Shown(
        name=scene.scene.names[0],
        reference=scene.scene.reference.images[0].cpu(),
        truths=scene.truths[:, 0].cpu(),
        modes=scene.modes,
        true_mode=scene.true_mode,
        samples=images[:count, 0].cpu(),
        classes=tuple(classes[:count].tolist()),
    )


def usable(scenes: HiddenModeScenes, count: int | None) -> Iterator[HiddenModes | DataError]:
    """The first scenes (all by default), or in the place of one that cannot be used the reason."""
    for index in range(len(scenes) if count is None else min(count, len(scenes))):
        try:
            yield scenes[index]
        except DataError as error:
            yield error
