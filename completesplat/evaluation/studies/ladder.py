"""Ladder of reconstructions, from the representation's best to one sample: where quality is lost."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from completesplat.evaluation.regions import counted_pixels
from completesplat.evaluation.studies.controls import OnProgress, Scenes
from completesplat.evaluation.studies.samples import SampleRenderer, mean_over_scenes, near_reference
from completesplat.gaussians import Gaussians
from completesplat.metrics.images import psnr, sharpness
from completesplat.sampling_settings import Sampling
from completesplat.scene import SceneBatch
from completesplat.splatter_image import SplatterImage

Rows = list[dict[str, str | float | None]]
BEHIND = 100.0  # degrees between the optical axes of a view from behind and of the reference
VIEWS_OF_A_STEP = 8
# Learning rates of Adam.
RAW_RATE = 0.03
DECODER_RATE = 2e-3
LATENT_RATE = 0.1


def ladder_rows(renderer: SampleRenderer, scenes: Scenes, fits: int, tick: OnProgress) -> Rows:
    """Return a row for each rung, with means over the scenes.

    The rungs: raw values of the Splatter Image, then the decoder's weights, then the latent, each fitted to all views
    of the scene in `fits` steps while the rest is kept; the mean of the posterior that sees all views (if it sees
    views); samples; the mean of the posterior that sees the reference image alone. `psnr` is of all views, `behind` of
    those more than `BEHIND` degrees from the reference. `sharpness_behind` is the gradient energy of these over the
    truth's, `sharpness_object` that of the object's pixels alone, where data have masks.
    """
    measured = defaultdict[str, list[dict[str, float | None]]](list)
    for scene in scenes:
        for rung, gaussians in _rungs(renderer, scene, fits):
            tick(f"{scene.names[0]}: {rung}, done")
            measured[rung].append(_scores(renderer, scene, gaussians))
    return [{"rung": rung, **mean_over_scenes(values)} for rung, values in measured.items()]


def _rungs(renderer: SampleRenderer, scene: SceneBatch, fits: int) -> Iterator[tuple[str, Gaussians]]:
    """Yield the name and the Gaussians [sample] of each rung of one scene (a batch of one)."""
    stage1 = renderer.model.autoreconstructor
    inputs = (scene.reference.cameras, scene.depth_range)
    images = scene.reference.images
    views = scene.all_views()
    with torch.no_grad():
        alone, features = stage1.posterior(images)
        seeing, _ = stage1.posterior(images, views, scene.depth_range)
    latent = seeing.mode()
    decoder = deepcopy(stage1.reconstructor).requires_grad_()
    start = stage1.reconstructor(latent, features).map(Tensor.detach)
    free_raw = start.raw.clone().requires_grad_()
    free_latent = latent.clone().requires_grad_()

    def fitted(parameters: Iterable[Tensor], rate: float, make: Callable[[], SplatterImage]) -> Gaussians:
        return _fitted(renderer, scene, fits, parameters, rate, lambda: make().gaussians(*inputs))

    yield "raw values fitted", fitted([free_raw], RAW_RATE, lambda: replace(start, raw=free_raw))
    yield "decoder fitted", fitted(decoder.parameters(), DECODER_RATE, lambda: decoder(latent, features))
    yield "latent fitted", fitted([free_latent], LATENT_RATE, lambda: stage1.reconstructor(free_latent, features))
    if stage1.sees_views:
        yield "posterior, all views", start.gaussians(*inputs)
    sampling = Sampling(samples=renderer.samples, seed=renderer.seed)
    yield "samples", renderer.model.generate(images, *inputs, sampling)
    yield "reference alone", stage1.reconstructor(alone.mode(), features).map(Tensor.detach).gaussians(*inputs)


def _fitted(
    renderer: SampleRenderer,
    scene: SceneBatch,
    fits: int,
    parameters: Iterable[Tensor],
    rate: float,
    make: Callable[[], Gaussians],
) -> Gaussians:
    """Return the Gaussians after steps of Adam on the mean square error of some views each, with a falling rate."""
    views = scene.all_views()
    optimizer = torch.optim.Adam(parameters, lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, fits)
    generator = torch.Generator().manual_seed(renderer.seed)
    for _ in range(fits):
        chosen = torch.randperm(views.images.shape[1], generator=generator)[:VIEWS_OF_A_STEP]
        drawn = renderer.rasterizer(make(), views.cameras[:, chosen]).over(renderer.background)
        optimizer.zero_grad()
        (drawn - views.images[:, chosen]).square().mean().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return make()


@torch.no_grad()
def _scores(renderer: SampleRenderer, scene: SceneBatch, gaussians: Gaussians) -> dict[str, float | None]:
    """Return the means over samples of the scores that `ladder_rows` explains."""
    views = scene.all_views()[0]
    rendering = renderer.rasterizer(gaussians, views.cameras.repeated(len(gaussians.means)))
    images = renderer.over_background(rendering)
    quality = torch.stack([psnr(sample, views.images) for sample in images])
    scores: dict[str, float | None] = {"psnr": quality.mean().item()}
    scores |= dict.fromkeys(("behind", "sharpness_behind", "sharpness_object"))
    behind = ~near_reference(scene.reference.cameras[0], views.cameras, BEHIND)
    if not behind.any():
        return scores
    scores["behind"] = quality[:, behind].mean().item()
    shown = views[behind]
    regions = {"sharpness_behind": counted_pixels(shown, "full")}
    if not (shown.masks > 0.5).all():  # without masks, all pixels are the object's
        regions["sharpness_object"] = counted_pixels(shown, "object")
    for name, counted in regions.items():
        by_sample = [sharpness(sample[behind], shown.images, counted) for sample in images]
        known = [sharp for sharp in by_sample if sharp is not None]
        if known:  # else the truth has no gradient
            scores[name] = sum(known) / len(known)
    return scores
