"""Skip and guidance weight: faithfulness to the input against diversity."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import torch

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.diffusion.guidance import check_guidance_weight
from completesplat.metrics.diversity import diversity
from completesplat.metrics.images import psnr
from completesplat.reports.sampling.drawing import Artist
from completesplat.reports.sampling.measures import farthest, mean_over_scenes, near, object_psnr
from completesplat.reports.sampling.strips import Strip
from completesplat.scene import SceneBatch

# From faithful to diverse (supplement, "Diverse Sampling").
PAPER = ((1.0, 0.2), (0.5, 0.5), (0.0, 0.5))


def grid(skip_weights: Sequence[float], guidance_weights: Sequence[float]) -> list[tuple[float, float]]:
    """All pairs of (skip weight, guidance weight), the paper's three included.

    Raises:
        CompleteSplatError: a weight outside of [0, 1].
    """
    pairs = {*product(map(float, skip_weights), map(float, guidance_weights)), *PAPER}
    for skip_weight, guidance_weight in pairs:
        allowed_skip_weight(skip_weight)
        check_guidance_weight(guidance_weight)
    return sorted(pairs)


def rows(
    artist: Artist,
    settings: Sequence[tuple[float, float]],
    scenes: Sequence[SceneBatch],
    near_degrees: float,
    tick: Callable[[str], None],
) -> list[dict[str, float | bool | None]]:
    """A row for each setting, mean over the scenes.

    `reference_psnr` is of the reference view; `near_object_psnr` of the true object's pixels in the targets that look
    at most `near_degrees` away from the reference: mostly surface that the input shows (which surface it shows exactly
    would take depth maps, which scenes have not got). `diversity` is of the targets.
    """

    def measure(scene: SceneBatch, skip_weight: float, guidance_weight: float) -> dict[str, float | None]:
        images = artist(scene, skip_weight=skip_weight, guidance_weight=guidance_weight)
        true = scene.all_views()
        seen = near(scene.reference.cameras[0], scene.targets.cameras[0], near_degrees)
        return {
            "reference_psnr": psnr(images[:, 0], true.images[:, 0].expand_as(images[:, 0])).mean().item(),
            "near_object_psnr": object_psnr(
                images[:, 1:][:, seen], scene.targets.images[0, seen], scene.targets.masks[0, seen]
            ),
            "diversity": diversity(images[:, 1:]),
        }

    return over_settings(settings, scenes, measure, tick)


def over_settings(
    settings: Sequence[tuple[float, float]],
    scenes: Sequence[SceneBatch],
    measure: Callable[[SceneBatch, float, float], Mapping[str, float | None]],
    tick: Callable[[str], None],
) -> list[dict[str, float | bool | None]]:
    """A row for each setting: the mean over the scenes of what is measured with its skip and guidance weight."""
    found: list[dict[str, float | bool | None]] = []
    for skip_weight, guidance_weight in settings:
        tick(f"skip weight {skip_weight:g}, guidance weight {guidance_weight:g}")
        means = mean_over_scenes([measure(scene, skip_weight, guidance_weight) for scene in scenes])
        paper = (skip_weight, guidance_weight) in PAPER
        found.append({"skip_weight": skip_weight, "guidance_weight": guidance_weight, "paper": paper, **means})
    return found


def strips(
    artist: Artist, settings: Sequence[tuple[float, float]], scene: SceneBatch, samples: int
) -> tuple[list[list[Strip | None]], list[str]]:
    """Rows by skip weight, columns by guidance weight: one sample's reference view, and several from far away.

    The far view is the target that looks in the direction most different from the reference's. The first row is the
    truth.
    """
    far = 1 + farthest(scene.reference.cameras[0], scene.targets.cameras[0])
    skips, weights = (sorted(set(values)) for values in zip(*settings, strict=True))
    true = scene.all_views().images[0]
    rows: list[list[Strip | None]] = [[Strip(true[[0, far]], "truth: reference, far"), *[None] * (len(weights) - 1)]]
    for skip in skips[::-1]:
        row: list[Strip | None] = []
        for weight in weights:
            if (skip, weight) not in settings:
                row.append(None)
                continue
            images = artist(scene, skip_weight=skip, guidance_weight=weight)
            shown = torch.cat([images[:1, 0], images[:samples, far]])
            row.append(Strip(shown, f"guidance {weight:g}", (skip, weight) in PAPER))
        rows.append(row)
    return rows, ["", *(f"skip {skip:g}" for skip in skips[::-1])]
