"""Writers of binary glTF (`.glb`): one for Gaussians, one for a mesh with colours at its vertices.

Gaussians take the extension KHR_gaussian_splatting. Readers without it show a cloud of coloured points. Formats: the
Khronos Group's glTF 2.0 specification, and the text of the extension (`extensions/2.0/Khronos/` in their repository,
version of 15 April 2026).
"""

import json
import logging
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned
from completesplat.export.mesh import VOXELS, Mesh
from completesplat.files import write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import transform_points
from completesplat.geometry.harmonics import SH_C0
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.version import __version__

EXTENSION = "KHR_gaussian_splatting"
RENDERING = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
UNLIT = "KHR_materials_unlit"
MATERIAL = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "extensions": {UNLIT: {}}}
ARRAY_BUFFER = 34962
ELEMENT_ARRAY_BUFFER = 34963
HEADER_BYTES = 12
COMPONENTS = {"float32": 5126, "uint16": 5123, "uint32": 5125}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TO_GLTF = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Half a turn about x, from our axes (+y down, +z forward) to those of glTF (+y up, cameras look along -z)."""

log = logging.getLogger(__name__)


def write_glb(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians to a file that appears whole or not at all.

    The given Gaussians have +y down and +z forward, and the file has +y up and +z backward. Only the points' colours
    are clipped to [0, 1]. `comments` are metadata.

    Returns:
        Number of Gaussians in the file, which omits those that cannot be stored.

    Raises:
        CompleteSplatError: no Gaussian can be stored.
    """
    stored = cleaned(gaussians, path).detach().to("cpu", torch.float32).transform(TO_GLTF)
    if not stored.count:
        raise CompleteSplatError(f"{path}: glTF has no empty sets of Gaussians")
    primitive = {"mode": 0, "extensions": {EXTENSION: RENDERING}}
    _write_gltf(path, _attributes(stored), primitive, {"extensionsUsed": [EXTENSION]}, comments)
    return stored.count


def write_mesh(path: Path, mesh: Mesh, comments: Sequence[str] = ()) -> None:
    """Write a mesh with colours at its vertices, turned as by `write_glb`, and log its resolution.

    Colours are float32, because trimesh keeps the lower half of the 16 bits of integers.
    """
    arrays = {
        "POSITION": transform_points(TO_GLTF, mesh.vertices.cpu()).numpy().astype("<f4"),
        "COLOR_0": _linear(mesh.colors.cpu(), torch.ones(len(mesh.colors), 1)).numpy().astype("<f4"),
        "indices": mesh.faces.astype("<u4").reshape(-1, 1),
    }
    used = {"extensionsUsed": [UNLIT], "materials": [MATERIAL]}
    _write_gltf(path, arrays, {"mode": 4, "material": 0}, used, comments)
    text = "%s: watertight, %d triangles; its longest side has %d voxels of %.2g units"
    log.info(text, path.name, len(mesh.faces), VOXELS, mesh.voxel)


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return arrays [gaussian, component] by attribute name of the glTF primitive."""
    opacities = gaussians.opacities.clamp(0, 1)[:, None]
    colors = gaussians.colors.clamp(0, 1)
    tensors = {
        "POSITION": gaussians.means,
        f"{EXTENSION}:ROTATION": normalize_quaternion(gaussians.quaternions).roll(-1, dims=-1),  # x, y, z, w
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (gaussians.colors - 0.5) / SH_C0,
    }
    arrays = {name: values.numpy().astype("<f4") for name, values in tensors.items()}
    arrays["COLOR_0"] = _linear(colors, opacities).mul(65535).round().numpy().astype("<u2")
    return arrays


def _linear(colors: Float[Tensor, "n 3"], opacities: Float[Tensor, "n 1"]) -> Float[Tensor, "n 4"]:
    """Convert sRGB to linear light (IEC 61966-2-1), in which glTF stores colours of points and vertices."""
    linear = torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return torch.cat([linear, opacities], dim=-1)


def _write_gltf(path: str | Path, arrays: dict[str, np.ndarray], primitive: Any, others: Any, comments: Any) -> None:
    """Write arrays [item, component] by name. `indices` are triangles, and all others attributes of the primitive."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    attributes: dict[str, int] = {}
    elements: dict[str, Any] = {"attributes": attributes}
    offset = 0
    for index, (name, array) in enumerate(arrays.items()):
        accessor: dict[str, Any] = {
            "bufferView": index,
            "count": len(array),
            "componentType": COMPONENTS[array.dtype.name],
            "type": TYPES[array.shape[1]],
        }
        if name == "POSITION":
            accessor["min"] = array.min(0).tolist()
            accessor["max"] = array.max(0).tolist()
        elif array.dtype == np.uint16:
            accessor["normalized"] = True
        accessors.append(accessor)
        target = ELEMENT_ARRAY_BUFFER if name == "indices" else ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        offset += array.nbytes  # each a multiple of four bytes
        if name == "indices":
            elements["indices"] = index
        else:
            attributes[name] = index
    elements.update(primitive)
    description = {
        "asset": {
            "version": "2.0",
            "generator": f"completesplat {__version__}",
            "extras": {"comments": list(comments)},
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [elements]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
        **others,
    }
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    content = b"".join(array.tobytes() for array in arrays.values())
    chunks = _chunk(b"JSON", text) + _chunk(b"BIN\0", content)
    header = struct.pack("<4sII", b"glTF", 2, HEADER_BYTES + len(chunks))
    write_bytes(path, header + chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack("<I4s", len(data), kind) + data
