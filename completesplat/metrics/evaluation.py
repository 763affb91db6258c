"""The protocol: per image, averaged over the views of a scene, then over scenes."""

from collections import defaultdict
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.metrics.images import object_only, psnr, ssim
from completesplat.scene import SceneBatch

METRICS = {"psnr": psnr, "ssim": ssim}


class Evaluation:
    """Collects the scores of several predictors over a test set.

    For each predictor: all pixels (`full`) and true object pixels (`object`), for the reference view and the novel
    views apart, by every metric (CO3D protocol, paper Section 4 and supplement).
    """

    def __init__(self) -> None:
        self.scores: dict[str, dict[tuple[str, str, str], list[float]]] = defaultdict(lambda: defaultdict(list))
        self.views: dict[str, int] = defaultdict(int)

    @torch.no_grad()
    def update(self, predictor: str, images: Float[Tensor, "batch view 3 height width"], scenes: SceneBatch) -> None:
        """Score images predicted for the reference (first view) and all targets; they are clipped to [0, 1]."""
        truth = scenes.all_views()
        clipped = images.clamp(0, 1)
        for b in range(len(images)):
            for region in ("full", "object"):
                predicted, true = clipped[b], truth.images[b]
                if region == "object":
                    predicted, true = (object_only(x, truth.masks[b]) for x in (predicted, true))
                for name, metric in METRICS.items():
                    values = metric(predicted, true)
                    self.scores[predictor][region, "reference", name].append(values[0].item())
                    self.scores[predictor][region, "novel", name].append(values[1:].mean().item())
            self.views[predictor] += images.shape[1] - 1

    def results(self) -> dict[str, Any]:
        """{predictor: {region: {view: {metric: mean over scenes}}, "scenes": n, "views": novel views in all}}."""
        results: dict[str, Any] = {}
        for predictor, scores in self.scores.items():
            entry: dict[str, Any] = {"scenes": 0, "views": self.views[predictor]}
            for (region, view, name), values in scores.items():
                entry["scenes"] = len(values)
                entry.setdefault(region, {}).setdefault(view, {})[name] = sum(values) / len(values)
            results[predictor] = entry
        return results
