"""Reader and writer of `.ply` files in the layout of the original 3D Gaussian Splatting code."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import PlyError
from completesplat.export.cleaning import bounded, cleaned
from completesplat.files import write_bytes
from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.harmonics import LARGEST_DEGREE, SH_C0, coefficients, degree_of
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.ply_files import read_vertices, vertex_header

SMALLEST_ALPHA = 1e-6
AXES_COMMENT = "coordinates as given, none turned; camera frames have +x right, +y down, +z forward (OpenCV)"
MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
FILTER = "filter_3D"  # of Mip-Splatting
QUATERNIONS = ("rot_0", "rot_1", "rot_2", "rot_3")
WRITTEN = (*MEANS, *NORMALS, *COLORS, "opacity", *SCALES, *QUATERNIONS)
REQUIRED = (*MEANS, *COLORS, "opacity", *SCALES[:2], *QUATERNIONS)  # and the third scale, which 2DGS has not

log = logging.getLogger(__name__)


def write_ply(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians in any frame to a file that appears whole or not at all.

    Opacities are clamped to [1e-6, 1 - 1e-6] before the logit. Reading the file with `read_ply` and writing it again
    gives the same bytes, except for clamped opacities. Quaternions may have any length. `comments` are lines of
    metadata for the header, in which characters outside ASCII are escaped.

    Returns:
        Number of Gaussians in the file, which omits those that cannot be stored.

    Raises:
        CompleteSplatError: no Gaussian of a nonempty set can be stored.
    """
    table = _table(cleaned(gaussians, path))
    further = _further_names(table.shape[1] - len(WRITTEN))
    names = [*MEANS, *NORMALS, *COLORS, *further, "opacity", *SCALES, *QUATERNIONS]
    header = vertex_header(len(table), [(name, "float") for name in names], (AXES_COMMENT, *comments))
    write_bytes(path, header + table.numpy().astype("<f4").tobytes())
    return len(table)


def _further_names(count: int) -> list[str]:
    """Return the names of colours' harmonics from degree 1 on: all of red, then of green, then of blue."""
    return [f"f_rest_{index}" for index in range(count)]


def _table(gaussians: Gaussians) -> Float[Tensor, "gaussian property"]:
    """Return a row for each Gaussian, computed in float64 so that only the stored float32 is rounded."""
    g = gaussians.detach().to("cpu").to(torch.float64)
    logits = g.opacities.logit(SMALLEST_ALPHA)[:, None]
    # Quaternions of unit length (up to float32 rounding) stay, because normalising them again would change bits.
    is_unit = (g.quaternions.square().sum(-1, keepdim=True) - 1).abs() < 1e-6
    rotations = torch.where(is_unit, g.quaternions, normalize_quaternion(g.quaternions))
    colors = [(g.colors - 0.5) / SH_C0]
    if isinstance(g, DirectionalGaussians):
        colors.append(g.harmonics.mT.flatten(1))
    rows = [g.means, torch.zeros_like(g.means), *colors, logits, g.scales.log(), rotations]
    return torch.cat(rows, dim=-1).float()


def read_ply(path: str | Path) -> Gaussians:
    """Read a 3DGS `.ply`, binary or ASCII, of this project or another.

    Colours' harmonics above degree 3 are left out, with a warning, and other properties are ignored, but for
    Mip-Splatting's filter, which is applied. Colours below 0 become 0, as in other 3DGS renderers.

    Raises:
        PlyError: `read_vertices` fails, the Gaussians are flat (2DGS), or none is finite. A warning counts those that
            are not.
    """
    try:
        vertices = read_vertices(path, REQUIRED)
        if SCALES[2] not in (vertices.dtype.names or ()):
            raise PlyError(f"no property {SCALES[2]}: flat Gaussians of 2DGS, which other programs render; give 3DGS")
    except PlyError as error:
        raise PlyError(f"{path}: {error}") from error.__cause__

    def gather(names: Sequence[str]) -> Float[Tensor, "gaussian channel"]:
        return torch.from_numpy(np.stack([vertices[name].astype(np.float64) for name in names], axis=-1))

    scales = gather(SCALES).exp()
    opacities = gather(["opacity"])[:, 0].sigmoid()
    if FILTER in (vertices.dtype.names or ()):
        scales, opacities = _smoothed(scales, opacities, gather([FILTER]))
    further = _further_harmonics(vertices, path)
    colors = 0.5 + SH_C0 * gather(COLORS)
    gaussians = Gaussians(
        means=gather(MEANS).float(),
        quaternions=gather(QUATERNIONS).float(),
        scales=scales.float(),
        opacities=opacities.float(),
        colors=(colors if further else colors.clamp(min=0)).float(),
    )
    if further:
        values = rearrange(gather(further), "gaussian (rgb coefficient) -> gaussian coefficient rgb", rgb=3)
        gaussians = DirectionalGaussians(**vars(gaussians), harmonics=values.float())
    return cleaned(gaussians, path, bounded)


def _smoothed(
    scales: Float[Tensor, "gaussian 3"], opacities: Float[Tensor, " gaussian"], filters: Float[Tensor, "gaussian 1"]
) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, " gaussian"]]:
    """Return scales and opacities after Mip-Splatting's 3D filter, which keeps the integral of a Gaussian (eq. 9)."""
    larger = (scales.square() + filters.square()).sqrt()
    return larger, opacities * (scales / larger).prod(dim=-1)


def _further_harmonics(vertices: np.ndarray, path: str | Path) -> list[str]:
    """Return the names of the harmonics that are used: all up to the largest degree that the package has."""
    names = [name for name in vertices.dtype.names or () if name.startswith("f_rest_")]
    count, rest = divmod(len(names), 3)
    degree = degree_of(count)
    if rest or set(names) != set(_further_names(3 * coefficients(degree))):
        log.warning("%s: %d properties f_rest_*, which no degree of harmonics has, are left out", path, len(names))
        return []
    if degree > LARGEST_DEGREE:
        log.warning("%s: colours' harmonics above degree %d are left out", path, LARGEST_DEGREE)
    used = range(min(count, coefficients(LARGEST_DEGREE)))
    return [f"f_rest_{channel * count + index}" for channel in range(3) for index in used]
