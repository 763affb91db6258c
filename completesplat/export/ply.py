"""Gaussians as a `.ply` file in the layout of the original 3D Gaussian Splatting code."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.atomic import atomic_path
from completesplat.errors import PlyError
from completesplat.export.cleaning import cleaned
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.splatter_image import SH_C0

LONGEST_HEADER, LONGEST_COUNT = 1 << 16, 15  # bytes, digits
HEADER = re.compile(rb"ply\s*\n(.*?)(?<=\n)end_header[ \t\r]*\n", re.DOTALL)
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
SMALLEST_ALPHA = 1e-6
AXES_COMMENT = "coordinates as given, none turned; camera frames have +x right, +y down, +z forward (OpenCV)"
MEANS, NORMALS, COLORS = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, QUATERNIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
WRITTEN = (*MEANS, *NORMALS, *COLORS, "opacity", *SCALES, *QUATERNIONS)
REQUIRED = (*MEANS, *COLORS, "opacity", *SCALES, *QUATERNIONS)


def write_ply(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians; the file appears whole or not at all.

    Opacities are clamped to [1e-6, 1 - 1e-6] before the logit. Reading the file with `read_ply` and writing it again
    gives the same bytes, except for clamped opacities.

    Args:
        gaussians: in any one frame; quaternions of any length.
        comments: metadata for the header, a line each; characters outside ASCII are escaped.

    Returns:
        How many Gaussians the file holds: those that can be stored; `CompleteSplatError` if there are none.
    """
    table = _table(cleaned(gaussians, path))
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(_header(len(table), comments))
        file.write(table.numpy().astype("<f4").tobytes())
    return len(table)


def _table(gaussians: Gaussians) -> Float[Tensor, "gaussian 17"]:
    """One row for each Gaussian; computed in float64, so that the stored float32 is the nearest one."""
    g = gaussians.detach().to("cpu", torch.float64)
    logits = g.opacities.logit(SMALLEST_ALPHA)[:, None]
    # A quaternion that is of unit length up to float32 rounding is kept: normalising it again would move its bits.
    is_unit = (g.quaternions.square().sum(-1, keepdim=True) - 1).abs() < 1e-6
    rotations = torch.where(is_unit, g.quaternions, normalize_quaternion(g.quaternions))
    rows = [g.means, torch.zeros_like(g.means), (g.colors - 0.5) / SH_C0, logits, g.scales.log(), rotations]
    return torch.cat(rows, dim=-1).float()


def _header(count: int, comments: Sequence[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    # A line break inside a comment would start a header line of its own.
    lines += [f"comment {' '.join(comment.split())}" for comment in (AXES_COMMENT, *comments)]
    lines += [f"element vertex {count}", *(f"property float {name}" for name in WRITTEN), "end_header", ""]
    return "\n".join(lines).encode("ascii", "backslashreplace")


def read_ply(path: str | Path) -> Gaussians:
    """Read a binary little-endian 3DGS `.ply`, of this project or another.

    Properties beyond the layout (f_rest_*: the view-dependent part of the colour) are ignored. Colours below 0
    become 0, as in the renderers of such files. `PlyError`: no such file, another format or size than the header
    declares, or values that are not finite.
    """
    try:
        if not Path(path).is_file():
            raise PlyError("no such file")
        with Path(path).open("rb") as file:
            gaussians = _gaussians(_vertices(file))
    except OSError as error:
        raise PlyError(f"{path}: {error.strerror or error}") from error
    except PlyError as error:
        raise PlyError(f"{path}: {error}") from None
    damaged = int((~gaussians.finite()).sum())
    if damaged:
        raise PlyError(f"{path}: {damaged} of {gaussians.count} Gaussians are not finite")
    return gaussians


def _vertices(file: BinaryIO) -> np.ndarray:
    start = file.read(LONGEST_HEADER)
    if not start.startswith(b"ply"):
        raise PlyError("not a .ply file")
    header = HEADER.match(start)
    if header is None:
        raise PlyError("no end of the header found")
    places: dict[str, tuple[np.dtype[np.void], int, int]] = {}
    end = header.end()
    for name, count, fields in _elements(header[1].decode("ascii", "replace").splitlines()):
        if len(dict(fields)) < len(fields):
            raise PlyError(f"element {name[:60]!r} names a property twice")
        places[name] = np.dtype(fields), count, end
        end += count * places[name][0].itemsize
    actual = file.seek(0, os.SEEK_END)
    if actual != end:
        raise PlyError(f"the header declares {end} bytes, the file has {actual}")
    if "vertex" not in places:
        raise PlyError("no element vertex")
    dtype, count, position = places["vertex"]
    missing = [name for name in REQUIRED if name not in (dtype.names or ())]
    if missing:
        raise PlyError(f"no property {', '.join(missing)}: not a 3D Gaussian Splatting file")
    file.seek(position)
    return np.fromfile(file, dtype, count)


def _elements(lines: Sequence[str]) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """Name, number of records, and names and types of their properties, in the order of the file."""
    if not lines or lines[0].strip() != "format binary_little_endian 1.0":
        raise PlyError("not a binary little-endian .ply file")
    declared: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[1:]:
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, count] if count.isdecimal() and len(count) <= LONGEST_COUNT:
                declared.append((name, int(count), []))
            case ["property", kind, name] if kind in TYPES and declared:
                declared[-1][2].append((name, TYPES[kind]))
            case _:
                raise PlyError(f"header line not understood: {line[:60]!r}")
    return declared


def _gaussians(vertices: np.ndarray) -> Gaussians:
    def gather(names: Sequence[str]) -> Float[Tensor, "gaussian channel"]:
        return torch.from_numpy(np.stack([vertices[name].astype(np.float64) for name in names], axis=-1))

    return Gaussians(
        means=gather(MEANS).float(),
        quaternions=gather(QUATERNIONS).float(),
        scales=gather(SCALES).exp().float(),
        opacities=gather(["opacity"])[:, 0].sigmoid().float(),
        colors=(0.5 + SH_C0 * gather(COLORS)).clamp(min=0).float(),
    )
