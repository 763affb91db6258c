"""Scores of a test set: means over a scene's views and then over scenes, for several predictors and samples."""

import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import isnan
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.loading.distributed import gather_values
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.records import BEST_BY_METRIC, BEST_OF_K, MEAN_OF_K, MODEL
from completesplat.evaluation.regions import REGIONS, counted_pixels, in_region, novel_values
from completesplat.metrics.image_sets import ImageSets, SetMetric
from completesplat.metrics.images import (
    ImageMetric,
    MissingMetrics,
    depth_errors,
    format_of,
    psnr,
    sharpness,
    ssim,
    values_of,
)
from completesplat.metrics.proper_scores import crps, energy_score, rank_histogram
from completesplat.metrics.sample_scores import SampledViews, best_sample, diversity, expected_best_curve, noisy_mean
from completesplat.scene import SceneBatch, Views

Scores = dict[tuple[str, str, str], float]
"""Scores of one scene by region, kind of view (`reference` or `novel`) and metric."""

BEST_RULES = {
    BEST_OF_K: "of each region one sample for all metrics: that with the best `criterion` there, in novel views",
    BEST_BY_METRIC: "of each region and metric another sample: the best by it, in novel views; no metrics of sets",
}
"""Rules by which rows choose the best sample. The paper states none."""

RESERVED_NAMES = ("sharpness", "energy", "crps", "fid", "kid")
"""Names of scores that are no image metrics, which metrics of the user's own cannot have."""


class SceneScores:
    """Scores of several predictors over a test set, scene by scene.

    Every metric scores each predictor on all pixels (`full`) and on true object pixels (`object`), for the reference
    view and the novel views apart (CO3D protocol, paper Section 4 and supplement). A scene counts once.

    Args:
        samples: number of samples per scene. With more than one, the rows are `model` (the first sample), two oracles
            (`best_of_k`, `best_of_k_by_metric`; see `BEST_RULES`) and `mean_of_k`.
        criterion: name of the metric that chooses the sample of `best_of_k`.
        seed: seed of the samples; a scene's seed depends on this one and on the scene's name only.
        metrics: image metrics by name (by default PSNR and SSIM), or why they are missing; null leaves one out.
        sets: metrics of whole sets of novel views by name, or why they are missing.
    """

    def __init__(
        self,
        samples: int = 1,
        criterion: str = "psnr",
        seed: int = 0,
        metrics: Mapping[str, ImageMetric | MissingMetrics | None] | None = None,
        sets: Mapping[str, SetMetric | MissingMetrics | None] | None = None,
    ) -> None:
        self.samples = samples
        self.criterion = criterion
        self.seed = seed
        self.first_novel = 1
        """Number of views before the novel ones: 1 (the reference that the model is given), or 0 without one."""
        self.metrics: dict[str, ImageMetric] = {}
        self.set_metrics: list[SetMetric] = []
        self.missing: dict[str, str] = {}
        """Reasons why metrics are missing, by the metrics' names."""
        for name, metric in (metrics or {"psnr": psnr, "ssim": ssim}).items():
            if isinstance(metric, MissingMetrics):
                self.missing |= dict.fromkeys(metric.names, str(metric))
            elif metric is not None:
                self.metrics[name] = metric
        for set_metric in (sets or {}).values():
            if isinstance(set_metric, MissingMetrics):
                self.missing |= dict.fromkeys(set_metric.names, str(set_metric))
            elif set_metric is not None:
                self.set_metrics.append(set_metric)
        self.formats = {name: format_of(name, metric) for name, metric in self.metrics.items()}
        self._check_settings()
        self.reset()

    def _check_settings(self) -> None:
        """Raise CompleteSplatError for a metric that cannot be used, or samples that cannot be chosen."""
        for name, metric in self.metrics.items():
            if name in RESERVED_NAMES or not name.isidentifier():
                raise CompleteSplatError(f"evaluation.metrics.{name}: choose another name, of letters and digits")
            if not callable(metric):
                raise CompleteSplatError(f"evaluation.metrics.{name}={metric}: give evaluation.metrics.{name}._target_")
        if self.samples < 1:
            raise CompleteSplatError(f"evaluation.scoring.samples={self.samples}: must be at least 1")
        setting = f"evaluation.scoring.criterion={self.criterion}"
        if self.criterion not in self.metrics:
            message = self.missing.get(self.criterion, f"choose one of {', '.join(self.metrics)}")
            raise CompleteSplatError(f"{setting}: {message}")
        if self.formats[self.criterion].higher_is_better is None:
            raise CompleteSplatError(f"{setting}: the metric needs `higher_is_better`")

    def reset(self) -> None:
        """Forget all scores."""
        self.sets = ImageSets(self.set_metrics)
        self.scores: dict[str, dict[str, Scores]] = defaultdict(dict)
        """Scores by predictor and scene."""
        self.views: dict[str, int] = {}
        """Number of novel views by scene."""
        self.of_samples: dict[str, dict[str, Any]] = {}
        """Figures of all samples of a scene together, by scene."""
        self.skipped: set[str] = set()
        """Names of scenes that could not be read."""

    def scene_seed(self, name: str) -> int:
        """Return the seed of a scene's samples, which does not depend on the scenes before it."""
        return zlib.crc32(f"{self.seed} {name}".encode())

    @torch.no_grad()
    def update(self, predictor: str, images: Float[Tensor, "batch view 3 height width"], scenes: SceneBatch) -> None:
        """Score images predicted for the reference (first view) and all targets. They are clipped to [0, 1]."""
        truth = scenes.all_views()
        for b, name in enumerate(scenes.names):
            clipped = images[b].clamp(0, 1)
            self._add(predictor, name, self.score(clipped, truth[b]), dict.fromkeys(REGIONS, clipped), truth[b])

    @torch.no_grad()
    def update_samples(self, name: str, images: SampledViews, truth: Views) -> None:
        """Add the scores of one scene's samples: of the first, of the best ones (`BEST_RULES`), and their mean."""
        images = images.clamp(0, 1)
        by_sample = [self.score(sample, truth) for sample in images]
        self._add(MODEL, name, by_sample[0], dict.fromkeys(REGIONS, images[0]), truth)
        if len(by_sample) == 1:
            return
        self._add_best(name, by_sample, images, truth)
        self.scores[MEAN_OF_K][name] = {
            key: sum(scores[key] for scores in by_sample) / len(by_sample) for key in by_sample[0]
        }
        proper, ranks = proper_scores(images[:, 1:], truth)
        self.scores[MODEL][name] |= proper
        higher = bool(self.formats[self.criterion].higher_is_better)
        by_criterion = [scores["full", "novel", self.criterion] for scores in by_sample]
        by_noise = self._scores_of_noisy_mean(name, images, truth)
        self.of_samples[name] = {
            "curve": expected_best_curve(by_criterion, higher),
            "curve_noisy_mean": expected_best_curve(by_noise, higher),
            "diversity": diversity(images[:, 1:]),
            "ranks": ranks,
        }

    def _scores_of_noisy_mean(self, name: str, images: SampledViews, truth: Views) -> list[float]:
        """Return the criterion in novel views of as many images as there are samples, by `noisy_mean`."""
        metric = self.metrics[self.criterion]
        true = truth.images[1:]
        counted = counted_pixels(truth[1:], "full")
        with torch.autocast(images.device.type, enabled=False):
            noisy = noisy_mean(images.float(), self.scene_seed(name))[:, 1:]
            return [values_of(metric, sample, true, counted).mean().item() for sample in noisy]

    def _add_best(self, name: str, by_sample: Sequence[Scores], images: SampledViews, truth: Views) -> None:
        """Add the scores of the samples that `BEST_RULES` choose from a scene's, given the scores of each."""
        best: dict[tuple[str, str], int] = {}
        for region in REGIONS:
            for metric, metric_format in self.formats.items():
                values = [scores[region, "novel", metric] for scores in by_sample]
                higher = metric_format.higher_is_better
                usable = higher is not None and not any(map(isnan, values))
                if usable or metric == self.criterion:
                    best[region, metric] = best_sample(values, bool(higher))
        by_criterion = {region: best[region, self.criterion] for region in REGIONS}
        keys = by_sample[0].keys()
        scores = {key: by_sample[by_criterion[key[0]]][key] for key in keys}
        self._add(BEST_OF_K, name, scores, {region: images[i] for region, i in by_criterion.items()}, truth)
        self.scores[BEST_BY_METRIC][name] = {
            (region, view, metric): by_sample[best[region, metric]][region, view, metric]
            for region, view, metric in keys
            if (region, metric) in best
        }

    def score(self, images: Float[Tensor, "view 3 height width"], truth: Views) -> Scores:
        """Score one prediction (values in [0, 1]) of one scene: means over the novel views, and their `sharpness`."""
        scores = Scores()
        first = self.first_novel
        for region in REGIONS:
            predicted = in_region(images, truth, region)
            true = in_region(truth.images, truth, region)
            counted = counted_pixels(truth, region)
            for name, metric in self.metrics.items():
                with torch.autocast(images.device.type, enabled=False):  # metrics compute in float32
                    values = values_of(metric, predicted.float(), true, counted)
                if values.shape != images.shape[:1]:
                    shapes = f"its values are {list(values.shape)}, not one for each of {len(images)} images"
                    raise CompleteSplatError(f"evaluation.metrics.{name}: {shapes}")
                if first:
                    scores[region, "reference", name] = values[0].item()
                scores[region, "novel", name] = values[first:].mean().item()
            sharp = sharpness(images[first:].float(), truth.images[first:], counted[first:])
            if sharp is not None:
                scores[region, "novel", "sharpness"] = sharp
        return scores

    @torch.no_grad()
    def update_depth(self, name: str, predicted: Float[Tensor, "view 1 height width"], true: Views) -> None:
        """Add the errors (`depth_errors`) of the depth of the model's first sample, such as `depth_abs_rel`."""
        assert true.depths is not None
        for region in REGIONS:
            errors = depth_errors(predicted, true.depths.to(predicted), counted_pixels(true, region))
            for kind, views in (("reference", errors[: self.first_novel]), ("novel", errors[self.first_novel :])):
                measured = [view for view in views if view is not None]
                for metric in measured[0] if measured else ():
                    mean = sum(view[metric] for view in measured) / len(measured)
                    self.scores[MODEL][name][region, kind, f"depth_{metric}"] = mean

    def _add(self, predictor: str, name: str, scores: Scores, images: Mapping[str, Tensor], truth: Views) -> None:
        """Keep a scene's scores, and describe its images [view 3 height width] in each region for set metrics."""
        self.scores[predictor][name] = scores
        self.views[name] = len(truth.images) - self.first_novel
        for region in REGIONS:
            for owner, views in ((predictor, images[region]), (ImageSets.TRUE, truth.images)):
                with torch.autocast(views.device.type, enabled=False):
                    self.sets.add(owner, region, name, in_region(views.float(), truth, region)[self.first_novel :])

    def gather(self) -> None:
        """Merge the scores of all processes. Each of them must call this."""
        of_this_process = self.scores, self.views, self.of_samples, self.sets.described, self.skipped
        self.reset()
        for scores, views, of_samples, descriptors, skipped in gather_values(of_this_process):
            for predictor, scenes in scores.items():
                self.scores[predictor] |= scenes
            for key, by_scene in descriptors.items():
                self.sets.described[key] |= by_scene
            self.views |= views
            self.of_samples |= of_samples
            self.skipped |= skipped

    def results(self) -> dict[str, Any]:
        """Return {predictor: {region: {view: {metric: mean over scenes}}, "scenes": n, "views": n of novel views}}."""
        results = {predictor: self._means_of(predictor) for predictor in self.scores}
        if not self.of_samples:
            return results
        scenes = [self.of_samples[name] for name in sorted(self.of_samples)]
        for kind in ("curve", "curve_noisy_mean"):
            results[BEST_OF_K][kind] = _means([scene[kind] for scene in scenes])
        results[MEAN_OF_K]["diversity"] = sum(scene["diversity"] for scene in scenes) / len(scenes)
        for region in ("full", "hidden"):
            ranks = [scene["ranks"][region] for scene in scenes if region in scene["ranks"]]
            if ranks:
                results[MEAN_OF_K][f"ranks_{region}"] = _means(ranks)
        return results

    def _means_of(self, predictor: str) -> dict[str, Any]:
        scenes = self.scores[predictor]
        names = sorted(scenes)
        entry: dict[str, Any] = {"scenes": len(names), "views": sum(self.views[name] for name in names)}
        for key in dict.fromkeys(key for name in names for key in scenes[name]):
            region, view, metric = key
            values = [scenes[name][key] for name in names if key in scenes[name]]
            entry.setdefault(region, {}).setdefault(view, {})[metric] = sum(values) / len(values)
        for region in REGIONS:
            entry[region]["novel"] |= self.sets.results(predictor, region, self.missing)
        return entry


def _means(rows: Sequence[Sequence[float]]) -> list[float]:
    return [sum(values) / len(rows) for values in zip(*rows, strict=True)]


def proper_scores(images: SampledViews, truth: Views) -> tuple[Scores, dict[str, list[float]]]:
    """Return `energy`, `crps` and rank histograms of the novel views, for each region of `novel_values`."""
    scores = Scores()
    ranks = {}
    for region, (sampled, true) in novel_values(images, truth).items():
        scores[region, "novel", "energy"] = energy_score(sampled, true)
        scores[region, "novel", "crps"] = crps(sampled, true)
        ranks[region] = rank_histogram(sampled, true).tolist()
    return scores, ranks
