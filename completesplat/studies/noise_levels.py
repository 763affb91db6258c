"""Noise levels at which the modes of what is hidden part, for the denoiser and for one that knows everything else."""

from collections.abc import Callable, Iterable, Sequence
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
"""Timesteps, as shares of those of training; in flow matching, the share of the noise."""
TIMESTEPS_DRAWN = 100_000
Row = dict[str, float]


def scenes_in_all_modes(
    scenes: HiddenModeScenes, count: int, progress: Callable[[Sequence[int]], Iterable[int]]
) -> list[SceneBatch]:
    """Return the first `count` usable scenes, each in every mode [mode]."""
    versions: list[SceneBatch] = []
    for index in progress(range(len(scenes))):
        try:
            versions += [scenes.versions(index)] if len(versions) < count else []
        except DataError:  # its reference shows what should be hidden
            continue
    if not versions:
        raise CompleteSplatError("no test scene has a hidden part with known modes")
    return versions


@torch.no_grad()
def rows(model: CompleteSplat, scenes: Sequence[SceneBatch], draws: int, seed: int) -> list[Row]:
    """Return a row for each of `LEVELS`, with means over scenes, modes and draws of noise.

    `best_share` is the probability that the noisy latent leaves to its own mode, if all but the mode is known: 0.25 for
    four modes in pure noise, 1 where they have parted. `denoiser_share` is the weight of this mode in the denoiser's
    estimate of the clean latent, as the sum of the modes' latents that is nearest to it. A denoiser that lies below
    blends the modes. `training_share` is that of the training's timesteps up to this level and above the one before,
    `steps` the number of the sampler's steps there.
    """
    total = model.sampler.training_timesteps
    levels = [round(level * total) for level in LEVELS]
    sums = torch.zeros(len(levels), 2)
    generator = torch.Generator().manual_seed(seed)
    for versions in scenes:
        modes = standardised(model, versions)
        condition = model.conditioning(versions.reference.images[:1]).expand(draws * len(modes.mean), -1, -1, -1)
        for index, level in enumerate(levels):
            sums[index] += shares(model, modes, condition, level, draws, generator)
    drawn = model.sampler.draw_timesteps(TIMESTEPS_DRAWN, torch.device("cpu"))
    steps = model.sampler.set_up().timesteps.cpu()
    limits = [-1, *levels[:-1], total]
    table: list[Row] = []
    for share, (best, predicted), low, high in zip(LEVELS, sums / len(scenes), limits, limits[1:], strict=False):
        inside = [((times > low) & (times <= high)).double() for times in (drawn, steps)]
        counted = {"training_share": inside[0].mean().item(), "steps": inside[1].sum().item()}
        table.append({"level": share, "best_share": best.item(), "denoiser_share": predicted.item(), **counted})
    return table


def standardised(model: CompleteSplat, versions: SceneBatch) -> Posterior:
    """Return the posteriors [mode] of a scene in all its modes, from all views, as the denoiser sees them."""
    posterior, _ = model.autoreconstructor.posterior(
        versions.reference.images, versions.all_views(), versions.depth_range
    )
    return Posterior(model.standardised(posterior.mean), posterior.log_variance - 2 * model.latent_std.log())


def shares(
    model: CompleteSplat, modes: Posterior, condition: Tensor, level: int, draws: int, generator: torch.Generator
) -> Float[Tensor, "2"]:
    """Return the mean share of the true mode for the best classifier of noisy latents, and for the denoiser."""
    true = torch.arange(len(modes.mean)).repeat_interleave(draws)
    noise = [torch.randn(len(true), *modes.mean.shape[1:], generator=generator).to(modes.mean) for _ in range(2)]
    timestep = torch.tensor(level, device=modes.mean.device)
    signal, share = signal_and_noise(model.sampler.scheduler, timestep, modes.mean)
    noisy = signal * (modes.mean[true] + modes.std[true] * noise[0]) + share * noise[1]
    variance = (signal * modes.std).square().mean() + share.square()
    distances = (noisy[:, None] - signal * modes.mean).square().flatten(2).sum(-1)
    best = (-distances / (2 * variance.view(1, 1))).softmax(1)
    predicted = model.denoiser(noisy, timestep.expand(len(noisy)), condition)
    clean = clean_estimate(model.sampler.scheduler, noisy, predicted, timestep).flatten(1)
    base, *others = modes.mean.flatten(1)
    weights = torch.linalg.lstsq(torch.stack([x - base for x in others], 1), (clean - base).T).solution.T
    weights = torch.cat([1 - weights.sum(1, keepdim=True), weights], 1)
    return torch.stack([x.gather(1, true.to(x.device)[:, None]).mean() for x in (best, weights)]).cpu()


def plot(table: Sequence[Row], path: Path, title: str) -> None:
    """Write a PNG of both shares by noise level, above the training's and the sampler's timesteps."""
    with written_figure(path, title, (8, 6)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        levels = [row["level"] for row in table]
        top.plot(levels, [row["best_share"] for row in table], "o-", label="if all else is known")
        top.plot(levels, [row["denoiser_share"] for row in table], "o-", label="denoiser")
        top.set(ylabel="share of the true mode", ylim=(0, 1.05))
        top.legend()
        steps = sum(row["steps"] for row in table)
        bottom.bar(levels, [row["training_share"] for row in table], 0.018, label="timesteps of training")
        bottom.bar([x + 0.018 for x in levels], [row["steps"] / steps for row in table], 0.018, label="sampler's steps")
        bottom.set(xlabel="noise level", ylabel="share, up to this level")
        bottom.legend()
