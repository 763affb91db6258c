"""Writers of compressed splats: `.spz` (Niantic's format) and `.compressed.ply` (PlayCanvas'), by gsply."""

from pathlib import Path
from typing import Any, Literal

import torch

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned, transparent
from completesplat.files import atomic_path, write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.harmonics import SH_C0
from completesplat.geometry.rotations import normalize_quaternion

SpzVersion = Literal[3, 4]
TO_SPZ = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Half a turn about x, from our axes (+y down, +z forward) to those of the format (+y up, +z backward)."""
LARGEST_LOGIT = 15.0


def write_spz(path: str | Path, gaussians: Gaussians, version: SpzVersion = 3) -> int:
    """Write one unbatched set of Gaussians, without those that are `transparent`.

    Args:
        version: 3 (gzip) is what Spark and GaussianSplats3D read, 4 (zstd) is the newest.

    Returns:
        Number of Gaussians in the file.

    Raises:
        CompleteSplatError: no Gaussian can be stored.
    """
    from gsply import write_spz as write  # Numba's import, which most commands do not need

    stored = cleaned(gaussians, path)
    stored = stored[~transparent(stored)]
    if not stored.count:
        raise CompleteSplatError(f"{path}: all {gaussians.count} Gaussians are transparent")
    with atomic_path(path) as temporary:
        write(temporary, _data(stored.detach().to("cpu", torch.float32).transform(TO_SPZ)), version=version)
    return stored.count


def write_compressed_ply(path: str | Path, gaussians: Gaussians) -> int:
    """Write one unbatched set of Gaussians in 16 bytes each, sorted by place.

    Returns:
        Number of Gaussians in the file.

    Raises:
        CompleteSplatError: no Gaussian can be stored.
    """
    from gsply import compress_to_bytes

    stored = cleaned(gaussians, path)
    if not stored.count:
        raise CompleteSplatError(f"{path}: the format has no empty sets of Gaussians")
    write_bytes(path, compress_to_bytes(_data(stored.detach().to("cpu", torch.float32))))
    return stored.count


def _data(gaussians: Gaussians) -> Any:
    """Return gsply's type, with values as 3DGS' PLY has them."""
    from gsply import GSData

    opacities = gaussians.opacities.logit().clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    return GSData.from_arrays(
        means=gaussians.means.numpy(),
        scales=gaussians.scales.log().numpy(),
        quats=normalize_quaternion(gaussians.quaternions).numpy(),
        opacities=opacities.numpy(),
        sh0=((gaussians.colors - 0.5) / SH_C0).numpy(),
    )
