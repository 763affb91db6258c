"""Study of stage 1: quality of its reconstructions from one and several views, and depth of its layers on objects."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.cameras import pixel_centers, project, unproject
from completesplat.metrics.images import psnr
from completesplat.scene import SceneBatch, Views
from completesplat.studies.figures import written_figure
from completesplat.studies.samples import autoreconstructor_of, mean_over_scenes, object_psnr, reconstructed
from completesplat.training.stage import Stage

CLOSE = 0.3
"""Share of the thickness; a layer nearer to the back than this counts as on it."""


@torch.no_grad()
def rows_of_views(
    module: Stage, counts: Sequence[int], scenes: Sequence[SceneBatch], tick: Callable[[str], None]
) -> list[dict[str, float | None]]:
    """Return a row for each number of views, the reference included: mean PSNR (dB) over scenes (batches of one).

    All rows are scored on every other target, which no row has seen. The views that a row sees are spread evenly over
    the other targets.

    Raises:
        CompleteSplatError: the posterior sees one image only, or there are too few targets.
    """
    network = autoreconstructor_of(module)
    if network is None or not network.sees_views:
        raise CompleteSplatError("this model reconstructs from one image: it was not trained with posterior=views")
    most = min(scene.targets[:, ::2].images.shape[1] for scene in scenes)
    if max(counts) > most:
        raise CompleteSplatError(f"counts: {max(counts)} views, and half of the targets are {most}")
    results: list[dict[str, float | None]] = []
    for count in counts:
        tick(f"{count} views")
        means = mean_over_scenes([_measure(module, network, scene, count) for scene in scenes])
        results.append({"views": count, **means})
    return results


def _measure(
    module: Stage, network: VariationalAutoReconstructor, scene: SceneBatch, count: int
) -> dict[str, float | None]:
    candidates, scored = scene.targets[:, ::2], scene.targets[:, 1::2]
    chosen = torch.arange(1, count) * candidates.images.shape[1] // count  # evenly in the data's order, as in an orbit
    views = replace(scene, targets=candidates[:, chosen]).all_views()
    gaussians = reconstructed(network, scene, views)
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


@torch.no_grad()
def rows_of_layers(
    module: Stage, scenes: Sequence[SceneBatch], tick: Callable[[str], None]
) -> list[dict[str, float | str]]:
    """Return a row for the object's true back and each layer: means over the object's pixels of all scenes.

    Scenes are batches of one. `behind` is the distance from the true front along the reference's optical axis, in scene
    units; `ratio` is its mean over the mean thickness; `on_back` is the share of pixels whose layer is nearer to the
    back than `CLOSE` of the thickness. Gaussians are of the posterior's mode; a posterior that sees views sees all.

    Raises:
        CompleteSplatError: the model is not a variational autoreconstructor.
        DataError: no true depth, or no object.
    """
    network = autoreconstructor_of(module)
    if network is None:
        raise CompleteSplatError("this model has no layers: take a run of the autoreconstructor, or of stage 2")
    measured = []
    for number, scene in enumerate(scenes):
        tick(f"scene {number + 1} of {len(scenes)}")
        if scene.reference.depths is None:
            raise DataError("the data have no true depth", str(scene.names[0]))
        gaussians = reconstructed(network, scene, scene.all_views() if network.sees_views else None)
        size = scene.reference.images.shape[-2:]
        front = scene.reference.depths[0, 0]
        thickness, known = true_thickness(scene[0].reference, scene[0].targets)
        behind = gaussians.means[0, :, 2].view(-1, *size) - front
        opacity = gaussians.opacities[0].view(-1, *size)
        measured.append((behind[:, known], opacity[:, known], thickness[known]))
    behinds, opacities, thicknesses = (torch.cat(values, dim=-1) for values in zip(*measured, strict=True))
    if not len(thicknesses):
        raise DataError("no pixel shows an object whose back another view shows", ", ".join(scenes[0].names))
    results: list[dict[str, float | str]] = [{"layer": "true back", "behind": thicknesses.mean().item()}]
    for layer, (behind, opacity) in enumerate(zip(behinds, opacities, strict=True)):
        results.append(
            {
                "layer": f"layer {layer + 1}",
                "opacity": opacity.mean().item(),
                "behind": behind.mean().item(),
                "ratio": (behind.mean() / thicknesses.mean()).item(),
                "on_back": ((behind - thicknesses).abs() < CLOSE * thicknesses).float().mean().item(),
            }
        )
    return results


def true_thickness(
    reference: Views, others: Views
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Return the distance from the object's front to its last surface at the reference's pixels, and where it is known.

    The last surface is the farthest point of the object (mask over 0.5) that another view [view] shows in the pixel, by
    true depth. Distances are in the cameras' units, along the reference's optical axis; unknown if no view shows one.
    """
    assert reference.depths is not None
    assert others.depths is not None
    height, width = reference.images.shape[-2:]
    pixels = pixel_centers(height, width, others.depths.device, others.depths.dtype).flatten(0, 1)
    places, ahead = project(reference.cameras, unproject(others.cameras, pixels, others.depths.flatten(1)))
    inside = (ahead > 0) & (places >= 0).all(-1) & (places < places.new_tensor([width, height])).all(-1)
    inside &= (others.depths.flatten(1) > 0) & (others.masks.flatten(1) > 0.5)
    columns, lines = places[inside].floor().long().unbind(-1)
    last = torch.zeros(height * width, dtype=ahead.dtype, device=ahead.device)
    last.scatter_reduce_(0, lines * width + columns, ahead[inside], "amax")
    front = reference.depths[0]
    thickness = last.view(height, width) - front
    known = (reference.masks[0] > 0.5) & (front > 0) & (thickness > 0)
    return thickness, known
