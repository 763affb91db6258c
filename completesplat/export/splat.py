"""Record of one Gaussian in `.splat` files (antimatter15's format, 32 bytes), and their writer."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from completesplat.export.cleaning import cleaned
from completesplat.files import write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quaternions", "u1", 4)])


def write_splat(path: str | Path, gaussians: Gaussians) -> int:
    """Write one unbatched set of Gaussians in its order, as `write_ply` does, with colours clamped to [0, 1]."""
    stored = cleaned(gaussians, path).detach()
    records = np.zeros(stored.count, RECORD)
    records["means"] = stored.means.cpu()
    records["scales"] = stored.scales.cpu()
    records["colors"] = round_to_uint8(torch.cat([stored.colors, stored.opacities[:, None]], dim=-1) * 255)
    records["quaternions"] = round_to_uint8(normalize_quaternion(stored.quaternions) * 128 + 128)
    write_bytes(path, records.tobytes())
    return stored.count


def round_to_uint8(values: Tensor) -> UInt8[np.ndarray, "*shape"]:
    """Round values to bytes, those outside of 0 to 255 to the nearer end."""
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
