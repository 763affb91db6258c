"""Binary glTF with the extension KHR_gaussian_splatting; readers without it show a cloud of coloured points.

Formats: the Khronos Group's glTF 2.0 specification, and the text of the extension (`extensions/2.0/Khronos/` in their
repository, version of 15 April 2026).
"""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat import __version__
from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned
from completesplat.files import atomic_path
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.splatter_image import SH_C0

EXTENSION = "KHR_gaussian_splatting"
RENDERING = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
COMPONENTS = {"float32": 5126, "uint16": 5123}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TO_GLTF = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Half a turn about x, from our axes (+y down, +z forward) to those of glTF (+y up, cameras look along -z)."""


def write_glb(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians; the file appears whole or not at all.

    The frame has +y down and +z forward. Only the points' colours are clipped to [0, 1]. `comments` are metadata.

    Returns:
        Number of Gaussians in the file, which omits those that cannot be stored.

    Raises:
        CompleteSplatError: no Gaussian can be stored.
    """
    stored = cleaned(gaussians, path).detach().to("cpu", torch.float32).transform(TO_GLTF)
    if not stored.count:
        raise CompleteSplatError(f"{path}: glTF has no empty sets of Gaussians")
    arrays = _attributes(stored)
    content = b"".join(array.tobytes() for array in arrays.values())  # each a multiple of four bytes
    text = json.dumps(_description(arrays, len(content), comments)).encode()
    text += b" " * (-len(text) % 4)
    chunks = [struct.pack("<I4s", len(data), kind) + data for kind, data in ((b"JSON", text), (b"BIN\0", content))]
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, chunks))) + b"".join(chunks))
    return stored.count


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return arrays [gaussian, component] by attribute name of the glTF primitive."""
    opacities = gaussians.opacities.clamp(0, 1)[:, None]
    points = torch.cat([_linear(gaussians.colors.clamp(0, 1)), opacities], dim=-1)
    splats = {
        "ROTATION": normalize_quaternion(gaussians.quaternions).roll(-1, dims=-1),  # x, y, z, w
        "SCALE": gaussians.scales,
        "OPACITY": opacities,
        "SH_DEGREE_0_COEF_0": (gaussians.colors - 0.5) / SH_C0,
    }
    arrays = {"POSITION": gaussians.means} | {f"{EXTENSION}:{name}": values for name, values in splats.items()}
    as_floats = {name: values.numpy().astype("<f4") for name, values in arrays.items()}
    return as_floats | {"COLOR_0": points.mul(65535).round().numpy().astype("<u2")}


def _linear(colors: Float[Tensor, "gaussian 3"]) -> Float[Tensor, "gaussian 3"]:
    """Convert sRGB to linear light (IEC 61966-2-1), in which glTF stores colours."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def _description(arrays: dict[str, np.ndarray], size: int, comments: Sequence[str]) -> dict[str, Any]:
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    offset = 0
    for array in arrays.values():
        kind = {"componentType": COMPONENTS[array.dtype.name], "type": TYPES[array.shape[1]]}
        accessors.append({"bufferView": len(views), "count": len(array), **kind})
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": 34962})
        offset += array.nbytes
    names = {name: index for index, name in enumerate(arrays)}
    positions = arrays["POSITION"]
    accessors[names["POSITION"]] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    accessors[names["COLOR_0"]] |= {"normalized": True}
    primitive = {"attributes": names, "mode": 0, "extensions": {EXTENSION: RENDERING}}
    return {
        "asset": {"version": "2.0", "generator": f"completesplat {__version__}", "extras": {"comments": [*comments]}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
