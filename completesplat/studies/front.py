"""Differences between samples in the reference view, where all should show the input image, and their causes."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.export.images import Sheet, strip
from completesplat.scene import SceneBatch
from completesplat.studies.controls import Row, Scenes, Tick
from completesplat.studies.mode_benchmark import Renders, rungs
from completesplat.studies.samples import SampleRenderer, farthest, mean_over_scenes, object_psnr

AMPLIFIED = 10  # factor of the differences in the figure


@torch.no_grad()
def rows(renderer: SampleRenderer, scenes: Scenes, tick: Tick) -> tuple[list[dict[str, Any]], Sheet]:
    """Return a row for each rung with means of `figures` over the scenes, and a sheet of the first scene.

    The rungs are those of `mode_benchmark.rungs`, then the model's samples at skip weight 1, the same after two
    rounds of `fit_colors`, and at skip weight 0. The other scene is the previous one; with one scene there is no rung
    `other_scene`. The sheet shows two samples of each rung and their difference times `AMPLIFIED`, from both views.
    """
    methods = rungs(renderer.model.autoreconstructor, renderer.samples, renderer.samples)
    methods["samples"] = lambda scene, other, seed: renderer.generate(scene, seed=seed, skip_weight=1.0)
    methods["samples_fitted"] = lambda scene, other, seed: renderer.generate(scene, seed=seed, color_fits=2)
    methods["samples_without_skips"] = lambda scene, other, seed: renderer.generate(scene, seed=seed, skip_weight=0.0)

    def render(name: str, index: int) -> Renders:
        gaussians = methods[name](scenes[index], scenes[index - 1], renderer.seed + index)
        return renderer.over_background(renderer.rasterize(gaussians, scenes[index]))

    results, views = list[dict[str, Any]](), [0, farthest(scenes[0])]
    sheet = [strip(scenes[0].all_views().images[0, views], "truth: reference, far")]
    for name in [name for name in methods if name != "other_scene" or len(scenes) > 1]:
        tick(name)
        means = mean_over_scenes([figures(render(name, index), scene) for index, scene in enumerate(scenes)])
        results.append({"rung": name, **means})
        first, last = render(name, 0)[[0, -1]][:, views]
        cells = torch.stack([first, last, (AMPLIFIED * (first - last).abs()).clamp(max=1)], 1)
        sheet.append(strip(cells.flatten(0, 1), name))
    return results, sheet


def figures(images: Renders, scene: SceneBatch) -> Row:
    """Return PSNR (dB) in the reference view, and `difference` in it and the farthest, of all and of object pixels."""
    true, result = scene.all_views()[0], Row()
    for region, masks in (("", torch.ones_like(true.masks)), ("_object", true.masks)):
        result[f"reference{region}_psnr"] = object_psnr(images[:, :1], true.images[:1], masks[:1])
        for name, view in (("reference", 0), ("far", farthest(scene))):
            result[f"{name}{region}_difference"] = difference(images[:, view], masks[view] > 0.5)
    return result


def difference(images: Float[Tensor, "sample 3 height width"], mask: Bool[Tensor, "1 height width"]) -> float | None:
    """Return the absolute difference (1/255), mean over pairs of samples and pixels of a mask; None without pixels."""
    values = images[:, mask.expand_as(images[0])]
    pairs = torch.pdist(values, 1) / max(1, values.shape[1])
    return 255 * pairs.sum().item() / max(1, len(pairs)) if mask.any() else None
