"""Choice of a backend that works on this machine."""

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

import torch

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.cuda import CudaRasterizer
from completesplat.rasterizers.reference import ReferenceRasterizer

logger = logging.getLogger(__name__)

TOLERANCE = 1e-4


def _tiled(constants: RenderingConstants | None) -> Rasterizer:
    # Imported here, because the import fails where numba does.
    from completesplat.rasterizers.tiled import TiledRasterizer

    return TiledRasterizer(constants)


FASTER: dict[str, Callable[[RenderingConstants | None], Rasterizer]] = {"cuda": CudaRasterizer, "tiled": _tiled}
"""Backends that may not work everywhere, the fastest first."""


def auto(constants: RenderingConstants | None = None) -> Rasterizer:
    """Return the fastest backend that works here with these constants.

    The choice is logged if there is a GPU, and so are backends that do not work. Every backend takes tensors of any
    device, so the choice does not depend on where a model runs: if there is a GPU, the Gaussians of a model on the CPU
    are drawn on it, too.
    """
    gpu = torch.cuda.is_available()
    for name, make in FASTER.items():
        reason = None if name == "tiled" and _passed_before(constants) else failure(name, constants)
        if reason is None:
            level = logging.INFO if gpu else logging.DEBUG
            logger.log(level, "rasterizer: %s (a test rendering agrees with the reference)", name)
            return make(constants)
        expected = name == "cuda" and not gpu
        logger.log(logging.DEBUG if expected else logging.WARNING, "rasterizer: not %s: %s", name, reason)
    logger.warning("rasterizer: reference, which takes minutes for an image and hours for a training")
    return ReferenceRasterizer(constants)


def cuda(constants: RenderingConstants | None = None) -> Rasterizer:
    """Return the `cuda` backend, without which training takes far too long.

    Raises:
        CompleteSplatError: it does not work here.
    """
    try:
        return CudaRasterizer(constants)
    except CompleteSplatError as error:
        raise CompleteSplatError(f"{error}; rasterizer=auto takes the fastest one that works here") from error


@cache
def failure(name: str, constants: RenderingConstants | None) -> str | None:
    """Return why a backend cannot be used, or None if it renders a tiny scene and its gradient correctly.

    Any exception is a reason: a missing package, kernels that do not compile (gsplat's are compiled on first use), a
    processor that numba does not know, a broken cache, refused constants.
    """
    try:
        actual = _image_and_gradient(FASTER[name](constants))
        expected = _image_and_gradient(ReferenceRasterizer(constants))
    except CompleteSplatError as error:
        return str(error)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    difference = torch.cat([(a - b).flatten() for a, b in zip(actual, expected, strict=True)]).abs().max().item()
    if not difference <= TOLERANCE:
        return f"its test rendering is wrong by {difference:.2g}"
    if name == "tiled":
        with suppress(OSError):
            _proof(constants).touch()
    return None


def _passed_before(constants: RenderingConstants | None) -> bool:
    """Return whether the tiled backend has passed its test in an earlier process under the same conditions."""
    with suppress(Exception):  # as in `failure`, which finds the reason
        return _proof(constants).exists()
    return False


def _proof(constants: RenderingConstants | None) -> Path:
    """Return the path of an empty file that exists if the tiled backend has passed its test.

    It lies beside the compiled kernels. Its name is a digest of all else that the result depends on.
    """
    from completesplat.rasterizers.kernels.compilation import cache_directory

    folder = cache_directory() or Path(os.devnull)
    settings = sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    files = sorted(Path(__file__).parent.glob("*.py")) + sorted(folder.glob("kernels_*/*.nb?"))
    facts = repr((settings, constants, torch.__version__)).encode()
    digest = sha256(b"".join([facts, *(path.read_bytes() for path in files)])).hexdigest()
    return folder / f"passed-{digest}"


@torch.enable_grad()
def _image_and_gradient(rasterizer: Rasterizer) -> tuple[torch.Tensor, torch.Tensor]:
    """Render a Gaussian off the centre of a 6 x 5 image, and return the image and a gradient of the mean."""
    mean = torch.tensor([[[0.05, -0.02, 2.0]]], requires_grad=True)
    quaternion = torch.tensor([[[1.0, 0.2, -0.1, 0.3]]])
    scale = torch.tensor([[[0.3, 0.2, 0.1]]])
    gaussians = Gaussians(mean, quaternion, scale, torch.tensor([[0.8]]), torch.tensor([[[0.9, 0.5, 0.1]]]))
    cameras = Cameras(torch.eye(4)[None, None], pinhole(40.0, 6)[None, None], (5, 6))
    color = rasterizer(gaussians, cameras).color
    (gradient,) = torch.autograd.grad(color.square().sum(), mean)
    return color.detach(), gradient
