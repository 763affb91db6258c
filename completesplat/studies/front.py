"""Differences of samples in the reference view, where the image says what they should show, and where they arise."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.export.images import SheetCell, strip
from completesplat.scene import SceneBatch
from completesplat.studies.controls import Row, Tick
from completesplat.studies.mode_benchmark import Renders, rungs
from completesplat.studies.samples import SampleRenderer, farthest, mean_over_scenes, object_psnr

AMPLIFIED = 10  # factor of the differences in the figure


@torch.no_grad()
def rows(
    renderer: SampleRenderer, scenes: Sequence[SceneBatch], tick: Tick
) -> tuple[list[dict[str, Any]], list[list[SheetCell | None]]]:
    """Return a row for each rung with means of `figures` over the scenes, and a sheet of the first scene.

    The rungs are those of the autoreconstructor (`rungs`; the other scene is the previous one, if there are several),
    and the model's samples with full skips and without. The sheet shows two samples of each rung and `AMPLIFIED` times
    their difference, in the reference view and then in the farthest.
    """
    methods = rungs(renderer.model.autoreconstructor, renderer.samples, renderer.samples)
    methods["samples"] = lambda scene, other, seed: renderer.generate(scene, seed=seed, skip_weight=1.0)
    methods["samples_without_skips"] = lambda scene, other, seed: renderer.generate(scene, seed=seed, skip_weight=0.0)

    def rendered(name: str, index: int) -> Renders:
        gaussians = methods[name](scenes[index], scenes[index - 1], renderer.seed + index)
        return renderer.over_background(renderer.rasterize(gaussians, scenes[index]))

    results, views = list[dict[str, Any]](), [0, farthest(scenes[0])]
    sheet = [strip(scenes[0].all_views().images[0, views], "truth: reference, far")]
    for name in [name for name in methods if name != "other_scene" or len(scenes) > 1]:
        tick(name)
        means = mean_over_scenes([figures(rendered(name, index), scene) for index, scene in enumerate(scenes)])
        results.append({"rung": name, **means})
        one, other = rendered(name, 0)[[0, -1]][:, views]
        cells = torch.stack([one, other, (AMPLIFIED * (one - other).abs()).clamp(max=1)], 1)
        sheet.append(strip(cells.flatten(0, 1), name))
    return results, sheet


def figures(images: Renders, scene: SceneBatch) -> Row:
    """Return PSNR (dB) in the reference view and `difference` there and in the farthest, of all and object pixels."""
    true, result = scene.all_views()[0], Row()
    for region, masks in (("", torch.ones_like(true.masks)), ("_object", true.masks)):
        result[f"reference{region}_psnr"] = object_psnr(images[:, :1], true.images[:1], masks[:1])
        for name, view in (("reference", 0), ("far", farthest(scene))):
            result[f"{name}{region}_difference"] = difference(images[:, view], masks[view] > 0.5)
    return result


def difference(images: Float[Tensor, "sample 3 height width"], mask: Bool[Tensor, "1 height width"]) -> float | None:
    """Return the mean absolute difference of two samples inside a mask, in 1/255; None without pixels."""
    values = images[:, mask.expand_as(images[0])]
    pairs = torch.pdist(values, 1) / max(1, values.shape[1])
    return 255 * pairs.sum().item() / max(1, len(pairs)) if mask.any() else None
