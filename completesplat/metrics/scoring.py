"""Evaluation protocol: scores per image, averaged over a scene's views, then over scenes; samples; depth errors."""

import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import combinations
from math import comb, isnan
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.data.loading.distributed import gather_values
from completesplat.errors import CompleteSplatError
from completesplat.geometry.surfaces import hidden_from
from completesplat.metrics.image_sets import ImageSets, SetMetric
from completesplat.metrics.images import ImageMetric, Images, MissingMetrics, psnr, sharpness, ssim, style_of, values_of
from completesplat.metrics.proper_scores import SampledValues, TrueValues, crps, energy_score, rank_histogram
from completesplat.scene import SceneBatch, Views

Scores = dict[tuple[str, str, str], float]
DepthMaps = Float[Tensor, "image 1 height width"]
SampledViews = Float[Tensor, "sample view 3 height width"]
REGIONS = ("full", "object")
MODEL = "model"
BEST = "best_of_k"
BEST_BY_METRIC = "best_of_k_by_metric"
MEAN = "mean_of_k"
BEST_RULES = {
    BEST: "of each region one sample for all metrics: that with the best `criterion` there, in novel views",
    BEST_BY_METRIC: "of each region and metric another sample: the best by it, in novel views; no metrics of sets",
}
"""Rules by which rows choose the best sample; the paper states none."""
TAKEN = ("sharpness", "energy", "crps", "fid", "kid")  # names of scores that are no image metrics


class Evaluation:
    """Scores of several predictors over a test set.

    Every metric scores each predictor on all pixels (`full`) and on true object pixels (`object`), for the reference
    view and the novel views apart (CO3D protocol, paper Section 4 and supplement). A scene counts once.

    Args:
        samples: number of samples per scene. With more than one, the rows are `model` (the first sample), two oracles
            (`best_of_k`, `best_of_k_by_metric`; see `BEST_RULES`) and `mean_of_k`.
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
        given = {name: x for name, x in (metrics or {"psnr": psnr, "ssim": ssim}).items() if x is not None}
        self.metrics = {name: metric for name, metric in given.items() if not isinstance(metric, MissingMetrics)}
        self.styles = {name: style_of(name, metric) for name, metric in self.metrics.items()}
        candidates = list((sets or {}).values())
        absent = [metric for metric in (*given.values(), *candidates) if isinstance(metric, MissingMetrics)]
        self.missing = {name: str(metric) for metric in absent for name in metric.names}
        self.samples = samples
        self.criterion = criterion
        self.seed = seed
        self.first_novel = 1
        """Views before the novel ones: 1, the reference that the model is given, or 0, if it is given none."""
        self._check_settings()
        self.set_metrics = [metric for metric in candidates if not isinstance(metric, MissingMetrics | None)]
        self.reset()

    def _check_settings(self) -> None:
        """Raise CompleteSplatError for a metric that cannot be used, or samples that cannot be chosen."""
        for name, metric in self.metrics.items():
            if name in TAKEN or not name.isidentifier():
                raise CompleteSplatError(f"evaluation.metrics.{name}: choose another name, of letters and digits")
            if not callable(metric):
                raise CompleteSplatError(f"evaluation.metrics.{name}={metric}: give evaluation.metrics.{name}._target_")
        if self.samples < 1:
            raise CompleteSplatError(f"evaluation.scoring.samples={self.samples}: must be at least 1")
        setting = f"evaluation.scoring.criterion={self.criterion}"
        if self.criterion not in self.metrics:
            message = self.missing.get(self.criterion, f"choose one of {', '.join(self.metrics)}")
            raise CompleteSplatError(f"{setting}: {message}")
        if self.styles[self.criterion].higher_is_better is None:
            raise CompleteSplatError(f"{setting}: the metric needs `higher_is_better`")

    def reset(self) -> None:
        self.sets = ImageSets(self.set_metrics)
        self.scores: dict[str, dict[str, Scores]] = defaultdict(dict)
        self.views: dict[str, int] = {}
        self.drawn: dict[str, dict[str, Any]] = {}
        self.skipped: set[str] = set()  # names of scenes that could not be read

    def scene_seed(self, name: str) -> int:
        """Return the seed of a scene's samples, which does not depend on the scenes before it."""
        return zlib.crc32(f"{self.seed} {name}".encode())

    @torch.no_grad()
    def update(self, predictor: str, images: Float[Tensor, "batch view 3 height width"], scenes: SceneBatch) -> None:
        """Score images predicted for the reference (first view) and all targets; they are clipped to [0, 1]."""
        truth = scenes.all_views()
        for b, name in enumerate(scenes.names):
            clipped = images[b].clamp(0, 1)
            self._add(predictor, name, self.score(clipped, truth[b]), dict.fromkeys(REGIONS, clipped), truth[b])

    @torch.no_grad()
    def update_samples(self, name: str, images: SampledViews, truth: Views) -> None:
        """Add the scores of one scene's samples: of the first, of the best ones (`BEST_RULES`), and their mean."""
        images = images.clamp(0, 1)
        each = [self.score(sample, truth) for sample in images]
        self._add(MODEL, name, each[0], dict.fromkeys(REGIONS, images[0]), truth)
        if len(each) == 1:
            return
        self._add_best(name, each, images, truth)
        self.scores[MEAN][name] = {key: sum(scores[key] for scores in each) / len(each) for key in each[0]}
        proper, ranks = proper_scores(images[:, 1:], truth)
        self.scores[MODEL][name] |= proper
        with torch.autocast(images.device.type, enabled=False):
            noisy = noisy_mean(images.float(), self.scene_seed(name))[:, 1:]
            metric = self.metrics[self.criterion]
            true = truth.images[1:]
            counted = _counted(truth[1:], "full")
            by_noise = [values_of(metric, noise, true, counted).mean().item() for noise in noisy]
        by = [scores["full", "novel", self.criterion] for scores in each]
        higher = bool(self.styles[self.criterion].higher_is_better)
        curves = {"curve": expected_best_curve(by, higher), "curve_noisy_mean": expected_best_curve(by_noise, higher)}
        self.drawn[name] = {**curves, "diversity": diversity(images[:, 1:]), "ranks": ranks}

    def _add_best(self, name: str, each: Sequence[Scores], images: SampledViews, truth: Views) -> None:
        """Add the scores of the samples that `BEST_RULES` choose from a scene's, given the scores of each."""
        chosen: dict[tuple[str, str], int] = {}
        for region in REGIONS:
            for metric, style in self.styles.items():
                values = [scores[region, "novel", metric] for scores in each]
                numbers = not any(map(isnan, values))
                if metric == self.criterion or (numbers and style.higher_is_better is not None):
                    chosen[region, metric] = best_sample(values, bool(style.higher_is_better))
        by_criterion = {region: chosen[region, self.criterion] for region in REGIONS}
        scores = {key: each[by_criterion[key[0]]][key] for key in each[0]}
        self._add(BEST, name, scores, {region: images[i] for region, i in by_criterion.items()}, truth)
        by_metric = {(r, v, m): each[chosen[r, m]][r, v, m] for r, v, m in each[0] if (r, m) in chosen}
        self.scores[BEST_BY_METRIC][name] = by_metric

    def score(self, images: Float[Tensor, "view 3 height width"], truth: Views) -> Scores:
        """Score one prediction (values in [0, 1]) of one scene: means over the novel views, and their `sharpness`."""
        scores = Scores()
        first = self.first_novel
        for region in REGIONS:
            predicted = _region(images, truth, region)
            true = _region(truth.images, truth, region)
            counted = _counted(truth, region)
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
            scores |= {} if sharp is None else {(region, "novel", "sharpness"): sharp}
        return scores

    @torch.no_grad()
    def update_depth(self, name: str, predicted: Float[Tensor, "view 1 height width"], true: Views) -> None:
        """Add errors of the depth of the model's first sample: `depth_abs_rel` and the others of `depth_errors`."""
        assert true.depths is not None
        for region in REGIONS:
            errors = depth_errors(predicted, true.depths.to(predicted), _counted(true, region))
            for kind, views in (("reference", errors[: self.first_novel]), ("novel", errors[self.first_novel :])):
                known = [view for view in views if view is not None]
                for metric in known[0] if known else ():
                    mean = sum(view[metric] for view in known) / len(known)
                    self.scores[MODEL][name][region, kind, f"depth_{metric}"] = mean

    def _add(self, predictor: str, name: str, scores: Scores, images: Mapping[str, Tensor], truth: Views) -> None:
        """Keep a scene's scores, and describe its images [view 3 height width] in each region for set metrics."""
        self.scores[predictor][name] = scores
        self.views[name] = len(truth.images) - self.first_novel
        for region in REGIONS:
            for owner, views in ((predictor, images[region]), (ImageSets.TRUE, truth.images)):
                with torch.autocast(views.device.type, enabled=False):
                    self.sets.add(owner, region, name, _region(views.float(), truth, region)[self.first_novel :])

    def gather(self) -> None:
        """Merge the scores of all processes; each of them must call this."""
        local = self.scores, self.views, self.drawn, self.sets.described, self.skipped
        self.reset()
        for scores, views, drawn, sets, skipped in gather_values(local):
            for predictor, scenes in scores.items():
                self.scores[predictor] |= scenes
            self.views |= views
            self.drawn |= drawn
            for key, described in sets.items():
                self.sets.described[key] |= described
            self.skipped |= skipped

    def results(self) -> dict[str, Any]:
        """Return {predictor: {region: {view: {metric: mean over scenes}}, "scenes": n, "views": n of novel views}}."""
        results = {predictor: self._means_of(predictor) for predictor in self.scores}
        if self.drawn:
            drawn = [self.drawn[name] for name in sorted(self.drawn)]
            for kind in ("curve", "curve_noisy_mean"):
                results[BEST][kind] = _means([scene[kind] for scene in drawn])
            results[MEAN]["diversity"] = sum(scene["diversity"] for scene in drawn) / len(drawn)
            for region in ("full", "hidden"):
                if ranks := [scene["ranks"][region] for scene in drawn if region in scene["ranks"]]:
                    results[MEAN][f"ranks_{region}"] = _means(ranks)
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


def noisy_mean(images: SampledViews, seed: int) -> SampledViews:
    """Return as many images: the samples' mean plus white noise of the same variance as the samples.

    Best of k gains from this noise too, so a gain of that size does not speak for the samples.
    """
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed)).to(images)
    return (images.mean(0) + images.var(0).mean().sqrt() * noise).clamp(0, 1)


def proper_scores(images: SampledViews, truth: Views) -> tuple[Scores, dict[str, list[float]]]:
    """Return `energy`, `crps` and rank histograms of the novel views, for each region of `novel_values`."""
    scores: Scores = {}
    ranks = {}
    for region, (drawn, true) in novel_values(images, truth).items():
        scores[region, "novel", "energy"] = energy_score(drawn, true)
        scores[region, "novel", "crps"] = crps(drawn, true)
        ranks[region] = rank_histogram(drawn, true).tolist()
    return scores, ranks


def novel_values(images: SampledViews, truth: Views) -> dict[str, tuple[SampledValues, TrueValues]]:
    """Return the values of the samples and the true values by region; the first view of `truth` is the reference.

    Regions are all pixels (`full`) and, if true depth is known, those that the reference view does not show (`hidden`).
    """
    novel = truth[1:]
    masks = {"full": torch.ones_like(truth.masks[1:, 0], dtype=torch.bool)}
    if truth.depths is not None and truth.depths.shape[-2:] == images.shape[-2:]:
        hidden, _ = hidden_from(truth.cameras[0], truth.depths[0], novel.cameras, truth.depths[1:])
        masks |= {"hidden": hidden} if hidden.any() else {}
    values = images.movedim(2, -1).float(), novel.images.movedim(1, -1).float()
    return {name: (values[0][:, mask].flatten(1), values[1][mask].flatten()) for name, mask in masks.items()}


def object_only(images: Images, masks: Float[Tensor, "image 1 height width"]) -> Images:
    """Make the background of images black, by the true mask binarised at 0.5 (supplement, "Objects only").

    The paper does not say whether its masks are soft; CO3D's own challenge binarises at 0.5.
    """
    return torch.where(masks > 0.5, images, torch.zeros_like(images))


def _region(images: Tensor, truth: Views, region: str) -> Tensor:
    return object_only(images, truth.masks) if region == "object" else images


def _counted(truth: Views, region: str) -> Bool[Tensor, "view 1 height width"]:
    return truth.masks > 0.5 if region == "object" else torch.ones_like(truth.masks, dtype=torch.bool)


def depth_errors(
    predicted: DepthMaps, true: DepthMaps, valid: Bool[Tensor, "image 1 _ _"]
) -> list[dict[str, float] | None]:
    """Return each image's errors over valid pixels with finite, positive true depth, without aligning the scale.

    `abs_rel`: mean of |predicted - true| / true; `rmse`: in the depth's unit; `delta1`: share of pixels where
    predicted / true and true / predicted are less than 1.25 (Eigen et al. 2014, Section 4.2). None for an image
    without any of these pixels. `predicted` is 0 where nothing is predicted.
    """
    errors: list[dict[str, float] | None] = []
    for estimate, depth, counted in zip(predicted, true, valid & true.isfinite() & (true > 0), strict=True):
        p = estimate[counted]
        t = depth[counted]
        ratio = torch.maximum(p / t, t / p)
        difference = p - t
        measured = {
            "abs_rel": (difference.abs() / t).mean().item(),
            "rmse": difference.square().mean().sqrt().item(),
            "delta1": ((ratio < 1.25) & (p > 0)).float().mean().item(),
        }
        errors.append(measured if len(t) else None)
    return errors


def best_sample(scores: Sequence[float], higher_is_better: bool = True) -> int:
    return scores.index(_worst_first(scores, higher_is_better)[-1])


def expected_best_curve(scores: Sequence[float], higher_is_better: bool = True) -> list[float]:
    """Return a list whose entry j - 1 is the mean, over all choices of j of the k samples, of the best score.

    Of k scores from worst to best, the i-th is the best of C(i - 1, j - 1) of the C(k, j) choices.

    Raises:
        ValueError: there are no scores, or one is not a number.
    """
    worst_first = _worst_first(scores, higher_is_better)
    k = len(scores)
    return [sum(comb(i, j) * score for i, score in enumerate(worst_first)) / comb(k, j + 1) for j in range(k)]


def _worst_first(scores: Sequence[float], higher_is_better: bool) -> list[float]:
    if not scores or any(isnan(score) for score in scores):
        raise ValueError(f"needs scores that are numbers, not {list(scores)}")
    return sorted(scores, reverse=not higher_is_better)


def diversity(images: SampledViews) -> float:
    """Return the root mean square difference of two samples' renders, averaged over all pairs and views."""
    differences = [(a - b).square().mean((1, 2, 3)).sqrt() for a, b in combinations(images, 2)]
    return torch.stack(differences).mean().item()
