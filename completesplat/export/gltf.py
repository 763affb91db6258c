"""Gaussians as binary glTF, with the extension KHR_gaussian_splatting; other readers see a cloud of coloured points.

Formats: the Khronos Group's glTF 2.0 specification, and the extension's own text (`extensions/2.0/Khronos/` of their
repository, in the version of 15 April 2026).
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
from completesplat.atomic import atomic_path
from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned
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
"""From our axes (+y down, +z forward) to glTF's (+y up, a camera looks along -z): half a turn about x."""


def write_glb(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians; the file appears whole or not at all.

    Args:
        gaussians: in any one frame of +y down, +z forward; colours beyond 0 to 1 are clipped for points only.
        comments: metadata, a line each.

    Returns:
        How many Gaussians the file holds: those that can be stored; `CompleteSplatError` if there are none.
    """
    kept = cleaned(gaussians, path).detach().to("cpu", torch.float32).transform(TO_GLTF)
    if not kept.count:
        raise CompleteSplatError(f"{path}: glTF has no empty sets of Gaussians")
    arrays = _attributes(kept)
    content = b"".join(array.tobytes() for array in arrays.values())  # each a multiple of four bytes
    text = json.dumps(_description(arrays, len(content), comments)).encode()
    text += b" " * (-len(text) % 4)
    chunks = [struct.pack("<I4s", len(data), kind) + data for kind, data in ((b"JSON", text), (b"BIN\0", content))]
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, chunks))) + b"".join(chunks))
    return kept.count


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Arrays [gaussian, component] by the names of the primitive's attributes."""
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
    """sRGB to linear light (IEC 61966-2-1), which glTF's own colours are."""
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
