"""Mode coverage of samples, for scenes in which every possible mode is known."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

SampledPixels = Float[Tensor, "sample pixel 3"]
ModePixels = Float[Tensor, "mode pixel 3"]
Probabilities = Float[Tensor, " mode"]
REJECTED = -1


def distances(samples: SampledPixels, modes: ModePixels) -> Float[Tensor, "sample mode"]:
    """Return the root mean square difference of every sample and every mode."""
    return torch.stack([(samples - mode).square().mean((1, 2)).sqrt() for mode in modes], dim=1)


def classify(samples: SampledPixels, modes: ModePixels, probabilities: Probabilities) -> Int64[Tensor, " sample"]:
    """Return the mode of each sample, or `REJECTED` if it is not near enough to one of at least two modes."""
    between = distances(modes, modes).fill_diagonal_(torch.inf)
    nearest, mode = distances(samples, modes).min(dim=1)
    from_mean = distances(samples, mean_of(modes, probabilities)[None])[:, 0]
    accepted = (nearest < between.min() / 2) & (nearest < from_mean)
    return mode.where(accepted, torch.full_like(mode, REJECTED))


def mean_of(modes: Float[Tensor, "mode *image _"], probabilities: Float[Tensor, " mode"]) -> Float[Tensor, "*image _"]:
    """Return the modes' mean, weighted by their probabilities."""
    return torch.tensordot(probabilities, modes, dims=1)


def scores(samples: SampledPixels, modes: ModePixels, probabilities: Probabilities) -> dict[str, float]:
    """Score one scene. Samples and modes are the region's pixels of all views in one row.

    `coverage`: share of the modes (of positive probability) that at least one sample belongs to. `total_variation`:
    half the sum of absolute differences between the samples' shares and the modes' probabilities. Rejected samples are
    a class of probability 0, so 1 is the worst. A perfect sampler with few samples does not reach 0, so compare with
    draws from the true distribution. `mode_distance`: mean distance of a sample to its nearest mode, divided by that of
    the modes' mean to its nearest mode (0: exactly modes). `rejected`: share of rejected samples.
    """
    classes = classify(samples, modes, probabilities)
    shares = torch.stack([(classes == mode).float().mean() for mode in range(len(modes))])
    rejected = (classes == REJECTED).float().mean()
    possible = probabilities > 0
    from_mean = distances(mean_of(modes, probabilities)[None], modes).min()
    return {
        "coverage": (shares[possible] > 0).float().mean().item(),
        "total_variation": 0.5 * ((shares - probabilities).abs().sum() + rejected).item(),
        "mode_distance": (distances(samples, modes).min(dim=1).values.mean() / from_mean).item(),
        "rejected": rejected.item(),
    }


def draw_modes(
    modes: Float[Tensor, "mode *image _"], probabilities: Float[Tensor, " mode"], samples: int, seed: int
) -> Float[Tensor, "sample *image _"]:
    """Draw modes by their probabilities, as a perfect model would."""
    generator = torch.Generator().manual_seed(seed)
    return modes[torch.multinomial(probabilities.cpu(), samples, replacement=True, generator=generator)]
