"""Disagreement of one input's samples in depth: the paper's figure of diversity in depth, with numbers."""

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.evaluation.studies.controls import OnProgress, Row, Scenes, WeightPairs, over_settings
from completesplat.evaluation.studies.samples import SampleRenderer, farthest, near_reference
from completesplat.export.images import NOTHING, Sheet, color_depth, color_normals, ramp, strip
from completesplat.geometry.surfaces import normals_from_depth
from completesplat.scene import SceneBatch


def deviation(depth: Float[Tensor, "sample *view 1 height width"]) -> Float[Tensor, "*view 1 height width"]:
    """Return the standard deviation of the depth over those samples that have one (more than 0) at a pixel.

    Its square is the unbiased variance, so pixels with different counts compare. It is NaN with fewer than two depths.
    """
    known = depth > 0
    count = known.sum(0)
    from_mean = torch.where(known, depth - depth.sum(0) / count, 0)
    return torch.where(count > 1, (from_mean.square().sum(0) / (count - 1)).sqrt(), torch.nan)


def depth_rows(
    renderer: SampleRenderer, settings: WeightPairs, scenes: Scenes, far_degrees: float, tick: OnProgress
) -> list[Row]:
    """Return a row for each (skip weight, guidance weight), with means over the scenes.

    `reference_deviation` is the mean of `deviation` over the reference view's pixels, in the scene's units;
    `far_deviation` is that over targets that look more than `far_degrees` away from the reference.
    `reference_object_deviation` and `far_object_deviation` are of the true object's pixels alone. `reference_measured`
    and `far_measured` are the shares of pixels where at least two samples are more than half opaque; only these count
    in the deviations. A figure that no scene has is None.
    """

    def measure(scene: SceneBatch, skip_weight: float, guidance_weight: float) -> Row:
        rendering = renderer.render(scene, skip_weight=skip_weight, guidance_weight=guidance_weight)
        return deviations(rendering.surface_depth(), scene, far_degrees)

    return over_settings(settings, scenes, measure, tick)


def deviations(depth: Float[Tensor, "sample view 1 height width"], scene: SceneBatch, far_degrees: float) -> Row:
    """Return the figures of `depth_rows` for one scene (a batch of one), given depths of all its views."""
    maps = deviation(depth)
    masks = scene.all_views().masks[0]
    far = 1 + torch.nonzero(~near_reference(scene.reference.cameras[0], scene.targets.cameras[0], far_degrees))[:, 0]
    figures: Row = {}
    for name, views in (("reference", far.new_zeros(1)), ("far", far)):
        figures[f"{name}_deviation"] = _mean(maps[views])
        figures[f"{name}_object_deviation"] = _mean(maps[views][masks[views] > 0.5])
        figures[f"{name}_measured"] = maps[views].isfinite().float().mean().item() if len(views) else None
    return figures


def _mean(values: Float[Tensor, "..."]) -> float | None:
    known = values[values.isfinite()]
    return known.mean().item() if len(known) else None


def depth_strips(
    renderer: SampleRenderer, scenes: Scenes, skip_weight: float, guidance_weight: float, shown: int
) -> Sheet:
    """Return a row for each scene: the truth, some samples in the far view, and where all samples disagree.

    The far view is the target whose direction differs most from the reference's. The truth is the input and the far
    view. A sample's images are its render, depth and normals in the far view. The standard deviation is that of the
    depth in both views, dark where the samples agree. The depths of a row share one scale, as do its deviations. Grey
    pixels show nothing, or have nothing to compare.
    """
    rows = []
    for scene in scenes:
        rendering = renderer.render(scene, skip_weight=skip_weight, guidance_weight=guidance_weight)
        far = farthest(scene)
        true = scene.all_views()
        depth = rendering.surface_depth()
        images = renderer.over_background(rendering)[:, far]
        depths, (nearest, deepest) = color_depth(depth[:shown, far])
        normals = color_normals(normals_from_depth(depth[:shown, far], true.cameras[0, far]))
        row = strip(true.images[0, [0, far]], f"{scene.names[0]}: input, far view")
        for sample, maps in enumerate(zip(images[:shown], depths, normals, strict=True)):
            row += strip(torch.stack(maps), f"sample {sample}: depth {nearest:.2f} to {deepest:.2f}")
        differences, end = color_deviation(deviation(depth[:, [0, far]]))
        rows.append([*row, *strip(differences, f"deviation 0 to {end:.2g}")])
    return rows


def color_deviation(maps: Float[Tensor, "view 1 height width"]) -> tuple[Float[Tensor, "view 3 height width"], float]:
    """Return colours (dark for 0, grey for NaN, one scale for all views) and the scale's end, the 98 % quantile."""
    known = maps.isfinite()
    end = maps[known].quantile(0.98).item() if known.any() else 0.0
    colors = ramp(torch.where(known, maps, 0) / max(end, 1e-12))
    return torch.where(known, colors, NOTHING), end
