"""Depth maps of CO3D: 16-bit grey PNGs whose bits are float16."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import BadImage, ImageError
from completesplat.photo.files import SIXTEEN_BIT_MODES, decoded

LARGEST_SCALE = 2.0**112  # its product with the largest float16 still fits into float32


def read_depth(path: Path, scale_adjustment: float) -> Float[Tensor, "1 height width"]:
    """Read a depth map, and multiply it by `scale_adjustment`.

    0 means "unknown", and replaces values that are not finite (`pytorch3d/implicitron/dataset/utils.py`, `load_depth`).

    Raises:
        MissingFile: the file does not exist.
        BadImage: it is no readable 16-bit PNG, the factor is not positive and finite, or depths are negative.
    """
    if not 0 < scale_adjustment < LARGEST_SCALE:
        raise BadImage(f"the depth's scale adjustment must be positive and finite, not {scale_adjustment}", str(path))
    with decoded(path, str(path), ("PNG",)) as (image, _):
        if image.mode not in SIXTEEN_BIT_MODES:
            raise ImageError(f"a depth map is a grey PNG of 16 bits, this has colour mode {image.mode}")
        depth = np.asarray(image).astype(np.uint16).view(np.float16).astype(np.float32)
        depth[~np.isfinite(depth)] = 0
        if depth.min() < 0:
            raise ImageError("negative depths; its bits are no float16")
    return torch.from_numpy(depth * np.float32(scale_adjustment))[None]
