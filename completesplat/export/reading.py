"""Reader of Gaussians in files of any program (`SPLATS`): `.ply`, `.splat`, and `.spz` of versions 2 to 4.

Formats: antimatter15's splat (32 bytes a Gaussian), and Niantic's `load-spz.cc`.
"""

import math
import struct
import zlib
from gzip import GzipFile
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from completesplat.errors import PlyError
from completesplat.export.formats import RECORD, TO_GLTF
from completesplat.export.ply import read_ply
from completesplat.gaussians import Gaussians
from completesplat.geometry.harmonics import SH_C0

HEADER = struct.Struct("<4sIIBBBBI")  # magic, version, count, degree, fractional bits, flags, streams, their table
WIDTHS = {2: (9, 1, 3, 3, 3), 3: (9, 1, 3, 3, 4), 4: (9, 1, 3, 3, 4)}  # bytes of a Gaussian in each part, by version
LARGEST_RATIO = 40  # of what a file unpacks to; splat-transform's have 2


def read_gaussians(path: str | Path) -> Gaussians:
    """Read a file of the format that its suffix names, in our axes; colours are the zeroth harmonics.

    Raises:
        PlyError: the file is missing or damaged, or has values that are not finite.
    """
    read = {".splat": _read_splat, ".spz": _read_spz}.get(Path(path).suffix.lower())
    if read is None:
        return read_ply(path)
    try:
        values = read(Path(path).read_bytes())
    except (OSError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise PlyError(f"{path}: damaged, missing, or of another version ({error})") from error
    gaussians = Gaussians(*(torch.from_numpy(value.astype(np.float32)) for value in values))
    if not gaussians.finite().all():
        raise PlyError(f"{path}: some Gaussians are not finite")
    return gaussians.transform(TO_GLTF) if read is _read_spz else gaussians  # `.spz` has +y up, +z towards the viewer


def _read_splat(content: bytes) -> list[np.ndarray]:
    records = np.frombuffer(content, RECORD)
    colors, rotations = records["colors"] / 255, records["quaternions"] / 128 - 1
    return [records["means"], rotations, records["scales"], colors[:, 3], colors[:, :3]]


def _read_spz(content: bytes) -> list[np.ndarray]:
    most = max(LARGEST_RATIO * len(content), 2**24)
    data = content if content.startswith(b"NGSP") else GzipFile(fileobj=BytesIO(content)).read(most)
    magic, version, count, _, bits, _, streams, table = HEADER.unpack_from(data)
    if magic != b"NGSP" or version not in WIDTHS or count * sum(WIDTHS[version]) > most:
        raise ValueError(f"version {version}, {count} Gaussians")
    ends = count * np.cumsum(WIDTHS[version])
    parts = _unpacked(data, table, streams, np.diff(ends, prepend=0)) if version == 4 else data[16 : 16 + ends[-1]]
    blocks = np.split(np.frombuffer(parts, np.uint8, ends[-1]), ends[:-1])
    places, opacities, colors, scales, rotations = (block.reshape(count, -1) for block in blocks)
    whole = np.pad(places.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0)))  # 24 bits in the upper part of 32
    return [
        np.ldexp(whole.view("<i4")[..., 0] >> 8, -bits),
        _quaternions(rotations),
        np.exp(scales / 16 - 10),
        opacities[:, 0] / 255,
        np.maximum(0.5 + SH_C0 * (colors / 255 - 0.5) / 0.15, 0),
    ]


def _unpacked(data: bytes, table: int, streams: int, sizes: np.ndarray) -> bytes:
    """Unpack the streams of version 4, behind a table of their sizes: packed, unpacked."""
    import pyarrow

    rows = np.frombuffer(data, "<i8", 2 * streams, table).reshape(streams, 2)[: len(sizes)]
    ends = table + 16 * streams + np.cumsum(rows[:, 0])
    packed = [data[end - length : end] for end, (length, _) in zip(ends, rows, strict=True)]
    return b"".join(pyarrow.decompress(x, int(n), "zstd", asbytes=True) for x, n in zip(packed, sizes, strict=True))


def _quaternions(packed: UInt8[np.ndarray, "gaussian bytes"]) -> Float[np.ndarray, "gaussian 4"]:
    """Unpack x, y, z of a byte each, or two bits that name the largest of x, y, z, w and ten for each other."""
    if packed.shape[1] == 3:
        fourth, three = np.full((len(packed), 1), 3), packed / 127.5 - 1
    else:
        word = packed.view("<u4")
        fourth, fields = word >> 30, word >> np.array([20, 10, 0], np.uint32)
        three = np.where(fields & 512, -1, 1) * (fields & 511) * (math.sqrt(0.5) / 511)
    others, quaternions = np.arange(4) != fourth, np.empty((len(packed), 4))
    quaternions[others], quaternions[~others] = three.ravel(), np.sqrt(np.maximum(0, 1 - (three**2).sum(-1)))
    return np.roll(quaternions, 1, axis=-1)
