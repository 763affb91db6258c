"""How well a scene is reconstructed from one view and from several, by a posterior that sees views."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.errors import CompleteSplatError
from completesplat.metrics.images import psnr
from completesplat.scene import SceneBatch
from completesplat.studies.figures import written_figure
from completesplat.studies.samples import autoreconstructor_of, mean_over_scenes, object_psnr


@torch.no_grad()
def rows(
    module: Any, counts: Sequence[int], scenes: Sequence[SceneBatch], tick: Callable[[str], None]
) -> list[dict[str, float | None]]:
    """A row for each number of views, the reference counted: mean PSNR (dB) over the scenes (batches of one).

    All rows are scored on the same targets, every other one, which no row has seen; those that are seen are spread
    evenly over the rest.

    `CompleteSplatError`: a posterior of one picture, or more views than that.
    """
    own = autoreconstructor_of(module)
    if own is None or not own.sees_views:
        raise CompleteSplatError("this model reconstructs from one picture: it was not trained with posterior=views")
    most = min(scene.targets[:, ::2].images.shape[1] for scene in scenes)
    if max(counts) > most:
        raise CompleteSplatError(f"counts: {max(counts)} views, and half of the targets are {most}")
    found: list[dict[str, float | None]] = []
    for count in counts:
        tick(f"{count} views")
        means = mean_over_scenes([_measure(module, own, scene, count) for scene in scenes])
        found.append({"views": count, **means})
    return found


def _measure(module: Any, own: VariationalAutoReconstructor, scene: SceneBatch, count: int) -> dict[str, float | None]:
    candidates, scored = scene.targets[:, ::2], scene.targets[:, 1::2]
    chosen = torch.arange(1, count) * candidates.images.shape[1] // count  # in the data's order, as around an object
    views = replace(scene, targets=candidates[:, chosen]).all_views()
    posterior, features = own.posterior(scene.reference.images, views, scene.depth_range)
    splatter_image = own.reconstructor(posterior.mode(), features)
    gaussians = splatter_image.gaussians(scene.reference.cameras, scene.depth_range)
    images = module.render_from(gaussians, scored.cameras[0]).over(module.background).clamp(0, 1)
    true = scored.images[0]
    return {"psnr": psnr(images[0], true).mean().item(), "object_psnr": object_psnr(images, true, scored.masks[0])}


def plot_views(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Write a PNG with PSNR against the number of views, of all pixels and of the object's."""
    with written_figure(path, title, (6, 4)) as figure:
        panel, counts = figure.subplots(), [row["views"] for row in rows]
        for key, label in (("psnr", "all pixels"), ("object_psnr", "the object's")):
            panel.plot(counts, [row[key] for row in rows], marker="o", label=label)
        panel.set(xlabel="views", ylabel="PSNR of other views, dB", xticks=counts)
        panel.grid(alpha=0.3)
        panel.legend()
