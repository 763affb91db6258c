"""Distances between two sets of features, by torchmetrics: FID and KID where the features are Inception's."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


def frechet_distance(first: Float[Tensor, "first feature"], second: Float[Tensor, "second feature"]) -> float:
    """Squared Frechet distance of the normal distributions fitted to two sets (Heusel et al. 2017, Eq. 6), in float64.

    Needs far more items than features for a trustworthy value; sets of different sizes must not be compared.

    Raises:
        ValueError: a set of less than two.
    """
    from torchmetrics.image.fid import FrechetInceptionDistance

    _check_sizes(first, second)
    given = nn.Identity()
    given.num_features = first.shape[1]  # type: ignore[assignment]
    # The sets are complete: among several processes torchmetrics would wait for the others' and add them.
    metric = FrechetInceptionDistance(given, sync_on_compute=False).to(first.device)
    metric.update(first.double(), real=True)
    metric.update(second.double(), real=False)
    return metric.compute().item()


def kernel_distance(
    first: Float[Tensor, "first feature"],
    second: Float[Tensor, "second feature"],
    subset_size: int = 1000,
    subsets: int = 100,
    seed: int = 0,
) -> float:
    """Squared maximum mean discrepancy, unbiased, hence at times below zero (Binkowski et al. 2018, Section 4).

    The kernel is (x.y / features + 1)^3. The mean over random subsets, in float64 and not multiplied by 1000; where a
    set is larger than a subset, it depends on the order of the items.

    Args:
        subset_size: items in a subset, at most; all items of the smaller set where it has fewer.
        subsets: number of subsets drawn from each set.
        seed: of the subsets.

    Raises:
        ValueError: a set of less than two.
    """
    from torchmetrics.image.kid import poly_mmd

    _check_sizes(first, second)
    size = min(subset_size, len(first), len(second))
    generator = torch.Generator().manual_seed(seed)
    values = []
    for _ in range(subsets):
        one, other = (x[torch.randperm(len(x), generator=generator)[:size].to(x.device)] for x in (first, second))
        values.append(poly_mmd(one.double(), other.double()))
    return torch.stack(values).mean().item()


def _check_sizes(first: Tensor, second: Tensor) -> None:
    if min(len(first), len(second)) < 2:
        raise ValueError("needs two items in each set")
