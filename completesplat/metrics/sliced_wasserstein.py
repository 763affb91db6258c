"""Sliced Wasserstein distance of two image sets on the levels of a Laplacian pyramid; it needs no weights.

Karras et al. 2018, "Progressive Growing of GANs", Section 5: patches of 7 x 7 pixels from every level down to 16
pixels, 128 per image and level, each channel normalised to mean 0 and standard deviation 1 over its set, 512
projections (four times 128 in their `metrics/sliced_wasserstein.py`).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, pad

Items = Float[Tensor, "item feature"]
PATCH = 7
SMALLEST_SIDE = 16
PROJECTIONS, REPEATS = 128, 4
SMALLEST_DEVIATION = 1e-4  # 1/40 of an 8-bit step: less is rounding and is not scaled up


def laplacian_pyramid(images: Float[Tensor, "image 3 height width"]) -> list[Float[Tensor, "image 3 _ _"]]:
    """Return Burt and Adelson's pyramid: full resolution first, then halved levels, a small image last."""
    if min(images.shape[-2:]) < SMALLEST_SIDE:
        raise ValueError(f"needs images of at least {SMALLEST_SIDE} pixels")
    levels = []
    while min(images.shape[-2:]) >= 2 * SMALLEST_SIDE:
        smaller = _blur(images)[..., ::2, ::2]
        levels.append(images - expand(smaller, images.shape[-2:]))
        images = smaller
    return [*levels, images]


def expand(images: Float[Tensor, "image 3 _ _"], size: Sequence[int]) -> Float[Tensor, "image 3 _ _"]:
    """Double images to `size` (height and width, which must be stated because either may be odd)."""
    spread = images.new_zeros(*images.shape[:2], *size)
    spread[..., ::2, ::2] = images
    return 4 * _blur(spread)


def _blur(images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image 3 height width"]:
    weights = images.new_tensor([1, 4, 6, 4, 1]) / 16
    kernel = torch.outer(weights, weights).expand(3, 1, 5, 5)
    return conv2d(pad(images, (2, 2, 2, 2), mode="reflect"), kernel, groups=3)


def descriptors(
    images: Float[Tensor, "image 3 height width"], seeds: Sequence[int], patches: int = 128
) -> list[Float[Tensor, "descriptor 147"]]:
    """Return patches of each pyramid level, not yet normalised; a level's patches of all images are one tensor.

    An image's patches depend on the image and its seed only, so several processes may describe parts of a set. A
    prediction and its truth share their seeds.

    Raises:
        ValueError: the images are smaller than 16 pixels.
    """
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    rows = torch.arange(len(images), device=images.device)[:, None]
    described = []
    for level in laplacian_pyramid(images.float()):
        windows = level.unfold(2, PATCH, 1).unfold(3, PATCH, 1)
        # Top and left of each patch: [2 image patch].
        places = [[torch.randint(n, (patches,), generator=g) for g in generators] for n in windows.shape[2:4]]
        top, left = (torch.stack(offsets).to(images.device) for offsets in places)
        described.append(windows[rows, :, top, left].flatten(0, 1).flatten(1))
    return described


def sliced_wasserstein(first: Sequence[Float[Tensor, "_ 147"]], second: Sequence[Float[Tensor, "_ 147"]]) -> float:
    """Return the mean distance over the levels of two sets' descriptors, times 1000 as in the paper's tables.

    It ignores brightness and contrast, because each set is normalised. The projections are always the same.
    """
    generator = torch.Generator().manual_seed(0)
    distances = []
    for a, b in zip(first, second, strict=True):
        sets = _normalized(a), _normalized(b)
        distances += [projected_distance(*sets, PROJECTIONS, generator) for _ in range(REPEATS)]
    return 1000 * torch.stack(distances).mean().item()


def projected_distance(first: Items, second: Items, projections: int, generator: torch.Generator) -> Float[Tensor, ""]:
    """Return the 1-Wasserstein distance of equal-sized sets on a line, mean over directions (Rabin et al. 2011)."""
    directions = torch.randn(projections, first.shape[1], generator=generator)
    directions = (directions / directions.norm(dim=1, keepdim=True)).to(first)
    a, b = ((directions @ x.T).sort(1).values for x in (first, second))
    return torch.mean((a - b).abs())


def _normalized(patches: Float[Tensor, "descriptor 147"]) -> Float[Tensor, "descriptor 147"]:
    """Subtract each channel's mean and divide by its standard deviation."""
    channels = patches.reshape(-1, 3, PATCH * PATCH)
    deviation, mean = torch.std_mean(channels, dim=(0, 2), correction=0, keepdim=True)
    return torch.flatten((channels - mean) / deviation.clamp(min=SMALLEST_DEVIATION), 1)
