"""Which backends work on this machine, and the choice among them."""

import logging
from functools import cache

import torch

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.protocol import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer

logger = logging.getLogger(__name__)

TOLERANCE = 1e-4


def available() -> dict[str, bool]:
    """The names of all backends, with whether each renders correctly here."""
    return {"tiled": _tiled_failure() is None, "reference": True}


def auto(constants: RenderingConstants | None = None) -> Rasterizer:
    """The fastest backend that works here and honours the constants; the choice and its reason are logged."""
    failure = _tiled_failure()
    if failure is None:
        from completesplat.rasterizers.tiled import TiledRasterizer

        try:
            rasterizer = TiledRasterizer(constants)
        except CompleteSplatError as error:
            failure = str(error)
        else:
            logger.info("rasterizer: tiled (a test rendering agrees with the reference)")
            return rasterizer
    logger.warning("rasterizer: reference, which is very slow, because tiled does not work: %s", failure)
    return ReferenceRasterizer(constants)


@cache
def _tiled_failure() -> str | None:
    """Why the tiled backend cannot be used, or None if a tiny scene comes out as it should, with its gradient.

    Any exception counts: a missing or too old numba, a processor that it does not know, a broken cache.
    """
    try:
        from completesplat.rasterizers.tiled import TiledRasterizer

        found, expected = _image_and_gradient(TiledRasterizer()), _image_and_gradient(ReferenceRasterizer())
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    difference = max((a - b).abs().max().item() for a, b in zip(found, expected, strict=True))
    return None if difference <= TOLERANCE else f"its test rendering is wrong by {difference:.2g}"


@torch.enable_grad()
def _image_and_gradient(rasterizer: Rasterizer) -> tuple[torch.Tensor, torch.Tensor]:
    """One Gaussian off the centre of a 6 x 5 image."""
    mean = torch.tensor([[[0.05, -0.02, 2.0]]], requires_grad=True)
    quaternion, scale = torch.tensor([[[1.0, 0.2, -0.1, 0.3]]]), torch.tensor([[[0.3, 0.2, 0.1]]])
    gaussians = Gaussians(mean, quaternion, scale, torch.tensor([[0.8]]), torch.tensor([[[0.9, 0.5, 0.1]]]))
    cameras = Cameras(torch.eye(4)[None, None], pinhole(40.0, 6)[None, None], (5, 6))
    color = rasterizer(gaussians, cameras).color
    (gradient,) = torch.autograd.grad(color.square().sum(), mean)
    return color.detach(), gradient
