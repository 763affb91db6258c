"""Reader and writer of `.ply` files in the layout of the original 3D Gaussian Splatting code."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import PlyError
from completesplat.export.cleaning import bounded, cleaned
from completesplat.files import write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.ply_files import header, read_vertices
from completesplat.splatter_image import SH_C0

SMALLEST_ALPHA = 1e-6
AXES_COMMENT = "coordinates as given, none turned; camera frames have +x right, +y down, +z forward (OpenCV)"
MEANS, NORMALS, COLORS = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, QUATERNIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
WRITTEN = (*MEANS, *NORMALS, *COLORS, "opacity", *SCALES, *QUATERNIONS)
REQUIRED = (*MEANS, *COLORS, "opacity", *SCALES, *QUATERNIONS)


def write_ply(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians in any frame; the file appears whole or not at all.

    Opacities are clamped to [1e-6, 1 - 1e-6] before the logit. Reading the file with `read_ply` and writing it again
    gives the same bytes, except for clamped opacities. Quaternions may have any length. `comments` are lines of
    metadata for the header; characters outside ASCII are escaped.

    Returns:
        Number of Gaussians in the file; those that cannot be stored are left out.

    Raises:
        CompleteSplatError: no Gaussian of a nonempty set can be stored.
    """
    table = _table(cleaned(gaussians, path))
    first = header(len(table), [(name, "float") for name in WRITTEN], (AXES_COMMENT, *comments))
    write_bytes(path, first + table.numpy().astype("<f4").tobytes())
    return len(table)


def _table(gaussians: Gaussians) -> Float[Tensor, "gaussian 17"]:
    """Return a row for each Gaussian, computed in float64 so that only the stored float32 is rounded."""
    g = gaussians.detach().to("cpu", torch.float64)
    logits = g.opacities.logit(SMALLEST_ALPHA)[:, None]
    # Quaternions of unit length (up to float32 rounding) stay, because normalising them again would change bits.
    is_unit = (g.quaternions.square().sum(-1, keepdim=True) - 1).abs() < 1e-6
    rotations = torch.where(is_unit, g.quaternions, normalize_quaternion(g.quaternions))
    rows = [g.means, torch.zeros_like(g.means), (g.colors - 0.5) / SH_C0, logits, g.scales.log(), rotations]
    return torch.cat(rows, dim=-1).float()


def read_ply(path: str | Path) -> Gaussians:
    """Read a 3DGS `.ply`, binary or ASCII, of this project or another.

    Other properties (f_rest_*: the view-dependent part of the colour) are ignored. Colours below 0 become 0, as in
    other 3DGS renderers.

    Raises:
        PlyError: `read_vertices` fails, or no Gaussian is finite; a warning counts those that are not.
    """
    try:
        vertices = read_vertices(path, REQUIRED)
    except PlyError as error:
        raise PlyError(f"{path}: {error}") from error.__cause__

    def gather(names: Sequence[str]) -> Float[Tensor, "gaussian channel"]:
        return torch.from_numpy(np.stack([vertices[name].astype(np.float64) for name in names], axis=-1))

    gaussians = Gaussians(
        means=gather(MEANS).float(),
        quaternions=gather(QUATERNIONS).float(),
        scales=gather(SCALES).exp().float(),
        opacities=gather(["opacity"])[:, 0].sigmoid().float(),
        colors=(0.5 + SH_C0 * gather(COLORS)).clamp(min=0).float(),
    )
    return cleaned(gaussians, path, bounded)
