"""Noise levels at which hidden modes can be told apart, by the denoiser and by the best classifier."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.hidden_modes import HiddenModeScenes
from completesplat.diffusion.objective import clean_estimate, signal_and_noise
from completesplat.errors import CompleteSplatError, DataError
from completesplat.generator import CompleteSplat
from completesplat.scene import SceneBatch
from completesplat.studies.figures import written_figure

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
"""Timesteps, as fractions of the number of training timesteps; in flow matching, the weight of the noise."""
TIMESTEPS_DRAWN = 100_000
Row = dict[str, float]


def scenes_in_all_modes(
    scenes: HiddenModeScenes, count: int, progress: Callable[[Sequence[int]], Iterable[int]]
) -> list[SceneBatch]:
    """Return the first `count` usable scenes, each in every mode [mode]."""
    versions: list[SceneBatch] = []
    for index in progress(range(len(scenes))):
        if len(versions) == count:
            break
        with suppress(DataError):  # e.g. its reference view shows the mode
            versions.append(scenes.versions(index))
    if not versions:
        raise CompleteSplatError("no test scene has a hidden part with known modes")
    return versions


@torch.no_grad()
def noise_level_rows(model: CompleteSplat, scenes: Sequence[SceneBatch], draws: int, seed: int) -> list[Row]:
    """Return a row for each of `LEVELS`, with means over scenes, modes and draws of noise.

    `best_share` is the true mode's probability given the noisy latent, for a classifier that knows the latents of all
    modes: with four modes, 0.25 in pure noise and 1 without noise. The denoiser's clean estimate is projected onto
    combinations of the modes' latents with weights of sum 1; `denoiser_share` is the true mode's weight. Where it is
    lower than `best_share`, the denoiser blends the modes.
    `training_share` is the share of training's timesteps from the previous level to this one, `steps` the sampler's
    there.
    """
    total = model.sampler.training_timesteps
    timesteps = [round(level * total) for level in LEVELS]
    sums = torch.zeros(len(timesteps), 2)
    generator = torch.Generator().manual_seed(seed)
    for versions in scenes:
        modes = standardised(model, versions)
        condition = model.conditioning(versions.reference.images[:1]).expand(draws * len(modes.mean), -1, -1, -1)
        for index, timestep in enumerate(timesteps):
            sums[index] += shares(model, modes, condition, timestep, draws, generator)
    training_times = model.sampler.draw_timesteps(TIMESTEPS_DRAWN, torch.device("cpu"))
    sampler_times = model.sampler.set_up().timesteps.cpu()
    limits = [-1, *timesteps[:-1], total]
    table: list[Row] = []
    for level, (best, predicted), low, high in zip(LEVELS, sums / len(scenes), limits, limits[1:], strict=False):
        inside = [((times > low) & (times <= high)).double() for times in (training_times, sampler_times)]
        counted = {"training_share": inside[0].mean().item(), "steps": inside[1].sum().item()}
        table.append({"level": level, "best_share": best.item(), "denoiser_share": predicted.item(), **counted})
    return table


def standardised(model: CompleteSplat, versions: SceneBatch) -> Posterior:
    """Return the posteriors [mode] of a scene in all its modes, given all views, in the denoiser's units."""
    images, views = versions.reference.images, versions.all_views()
    posterior, _ = model.autoreconstructor.posterior(images, views, versions.depth_range)
    return Posterior(model.standardised(posterior.mean), posterior.log_variance - 2 * model.latent_std.log())


def shares(
    model: CompleteSplat, modes: Posterior, condition: Tensor, step: int, draws: int, generator: torch.Generator
) -> Float[Tensor, "2"]:
    """Return the means of `best_share` and `denoiser_share` (see `noise_level_rows`) at one timestep."""
    true = torch.arange(len(modes.mean)).repeat_interleave(draws)
    noise = [torch.randn(len(true), *modes.mean.shape[1:], generator=generator).to(modes.mean) for _ in range(2)]
    timestep = torch.tensor(step, device=modes.mean.device)
    alpha, sigma = signal_and_noise(model.sampler.scheduler, timestep, modes.mean)
    noisy = alpha * (modes.mean[true] + modes.std[true] * noise[0]) + sigma * noise[1]
    variance = (alpha * modes.std).square().mean() + sigma.square()
    distances = (noisy[:, None] - alpha * modes.mean).square().flatten(2).sum(-1)
    best = (-distances / (2 * variance.view(1, 1))).softmax(1)
    predicted = model.denoiser(noisy, timestep.expand(len(noisy)), condition)
    clean = clean_estimate(model.sampler.scheduler, noisy, predicted, timestep).flatten(1)
    base, *others = modes.mean.flatten(1)
    weights = torch.linalg.lstsq(torch.stack([x - base for x in others], 1), (clean - base).T).solution.T
    weights = torch.cat([1 - weights.sum(1, keepdim=True), weights], 1)
    return torch.stack([x.gather(1, true.to(x.device)[:, None]).mean() for x in (best, weights)]).cpu()


def plot_noise_levels(table: Sequence[Row], path: Path, title: str) -> None:
    """Write a PNG with both shares by noise level, and below them the timesteps of training and of the sampler."""
    with written_figure(path, title, (8, 6)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        levels = [row["level"] for row in table]
        top.plot(levels, [row["best_share"] for row in table], "o-", label="best classifier")
        top.plot(levels, [row["denoiser_share"] for row in table], "o-", label="denoiser")
        top.set(ylabel="share of the true mode", ylim=(0, 1.05))
        top.legend()
        steps = sum(row["steps"] for row in table)
        bottom.bar(levels, [row["training_share"] for row in table], 0.018, label="timesteps of training")
        bottom.bar([x + 0.018 for x in levels], [row["steps"] / steps for row in table], 0.018, label="sampler's steps")
        bottom.set(xlabel="noise level", ylabel="share, from previous level")
        bottom.legend()
