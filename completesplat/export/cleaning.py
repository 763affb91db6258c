"""The Gaussians that can be stored and drawn: what is broken is taken out here, before any file or video is made.

Viewers hang on a single value that is not a number, and show nothing where one splat is endless.
"""

import logging

import torch
from jaxtyping import Bool
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians

# Renderers square scales and positions, in float32.
LARGEST = 1e18

log = logging.getLogger(__name__)


def storable(gaussians: Gaussians) -> Bool[Tensor, " gaussian"]:
    """Which Gaussians have finite values (of at most 1e18) and extents above 0 (as float32) along all axes."""
    bounded = [gaussians.opacities.abs() <= LARGEST]
    values = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.colors)
    bounded += [(x.abs() <= LARGEST).all(-1) for x in values]
    return torch.stack([*bounded, (gaussians.scales.float() > 0).all(-1)]).all(0)


def cleaned(gaussians: Gaussians, name: object) -> Gaussians:
    """One unbatched set without what cannot be stored; how much that was is logged as a warning.

    Args:
        name: of the file or sample, for the message.

    Raises:
        CompleteSplatError: nothing is left of a set that was not empty.
    """
    kept = storable(gaussians)
    broken = gaussians.count - int(kept.sum())
    if not broken:
        return gaussians
    if broken == gaussians.count:
        raise CompleteSplatError(f"{name}: all {broken} Gaussians are broken (not finite, or no extent)")
    log.warning("%s: left out %d of %d Gaussians (not finite, or no extent)", name, broken, gaussians.count)
    return gaussians.keep(kept)
