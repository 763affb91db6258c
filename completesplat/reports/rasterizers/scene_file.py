"""A scene in the layout of gsplat's `assets/test_garden.npz`: Gaussians with the cameras that see them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from completesplat.errors import DataError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras

NEEDED = ("means3d", "colors", "viewmats", "Ks", "width", "height")
# What stands in for arrays that the file lacks, as gsplat's file lacks all three: round and half transparent, of
# about the size that gsplat's own tests give them (0 to 0.02 world units, `gsplat/_helper.py`).
DEFAULTS: dict[str, Any] = {"quats": (1.0, 0.0, 0.0, 0.0), "scales": (0.01, 0.01, 0.01), "opacities": 0.5}


def read_scene(path: Path) -> tuple[Gaussians, Cameras, list[str]]:
    """One scene (batch of 1), its cameras, and the names of what was missing and got a default.

    Arrays: `means3d` [n 3], `colors` [n 3] (integers to 255, or floats to 1), `viewmats` [view 4 4] (world to
    camera), `Ks` [view 3 3] (pixels), `width`, `height`; if present `quats` [n 4] (wxyz), `scales` [n 3], `opacities`.

    Raises:
        DataError: no such file, not an npz, or an array missing, without numbers or of the wrong shape.
    """
    arrays = _arrays(path)
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}")

    count, views = len(np.atleast_1d(arrays["means3d"])), len(np.atleast_1d(arrays["viewmats"]))
    given = {name: np.broadcast_to(value, (count, *np.shape(value))) for name, value in DEFAULTS.items()} | arrays

    def tensor(name: str, *shape: int, unit: int = 1) -> Tensor:
        values = given[name]
        if values.shape != shape or 0 in shape or values.dtype.kind not in "iuf":
            found = f"{values.dtype} in the shape {list(values.shape)}"
            raise DataError(f"{path}: {name} should hold numbers in the shape {list(shape)}, not {found}")
        return torch.from_numpy(np.ascontiguousarray(values / unit, np.float32))[None]

    gaussians = Gaussians(
        tensor("means3d", count, 3),
        tensor("quats", count, 4),
        tensor("scales", count, 3),
        tensor("opacities", count),
        tensor("colors", count, 3, unit=255 if given["colors"].dtype.kind in "iu" else 1),
    )
    width, height = (float(tensor(name)) for name in ("width", "height"))
    if not (width.is_integer() and height.is_integer() and min(width, height) >= 1):
        raise DataError(f"{path}: an image of {width:g} x {height:g} pixels cannot be drawn")
    cameras = Cameras(tensor("viewmats", views, 4, 4), tensor("Ks", views, 3, 3), (int(height), int(width)))
    return gaussians, cameras, [name for name in DEFAULTS if name not in arrays]


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except Exception as error:  # of a broken archive zipfile, zlib and numpy may raise anything
        raise DataError(f"{path} is not an .npz file of plain arrays: {error}") from error
