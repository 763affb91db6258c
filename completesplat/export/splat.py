"""Gaussians as a `.splat` file, the smallest form that viewers in a browser read.

32 bytes for each Gaussian and no header, little endian: position and standard deviations as three float32 each, then
bytes: red, green, blue, opacity (0 to 255) and the unit quaternion (w, x, y, z) as 128 + 128 q. Source: the reader and
writer of antimatter15/splat. Coordinates as given, none turned: like in the `.ply`, +y is down.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.cleaning import cleaned
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quaternions", "u1", 4)])


def write_splat(path: str | Path, gaussians: Gaussians) -> int:
    """Write one unbatched set of Gaussians, in its order; the file appears whole or not at all.

    Colours beyond 0 to 1 are clamped.

    Returns:
        How many Gaussians the file holds; see `completesplat.export.cleaning` for what is left out.

    Raises:
        CompleteSplatError: none of the Gaussians can be stored.
    """
    kept = cleaned(gaussians, path).detach()
    records = np.zeros(kept.count, RECORD)
    records["means"], records["scales"] = kept.means.cpu(), kept.scales.cpu()
    records["colors"] = _bytes(torch.cat([kept.colors, kept.opacities[:, None]], dim=-1) * 255)
    records["quaternions"] = _bytes(normalize_quaternion(kept.quaternions) * 128 + 128)
    with atomic_path(path) as temporary:
        temporary.write_bytes(records.tobytes())
    return kept.count


def _bytes(values: Tensor) -> UInt8[np.ndarray, "*shape"]:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
