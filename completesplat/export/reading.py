"""Reader of Gaussians in files of any program (`SPLATS`): `.ply`, `.splat`, and `.spz` of versions 2 to 4.

Formats: antimatter15's splat (32 bytes a Gaussian), and Niantic's `load-spz.cc`. `splat-transform`, where it is
installed, unpacks others.
"""

import math
import os
import shutil
import struct
import tempfile
import zlib
from gzip import GzipFile
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from completesplat.errors import PlyError
from completesplat.export.cleaning import bounded, cleaned
from completesplat.export.ply import read_ply
from completesplat.export.splat import RECORD
from completesplat.export.splat_transform import PROGRAM, convert
from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.harmonics import LARGEST_DEGREE, SH_C0, coefficients, rotated
from completesplat.ply_files import LONGEST_HEADER, PACKED

HEADER = struct.Struct("<4sIIBBBBI")  # magic, version, count, degree, fractional bits, flags, streams, their table
WIDTHS = {2: (9, 1, 3, 3, 3), 3: (9, 1, 3, 3, 4), 4: (9, 1, 3, 3, 4)}  # bytes of a Gaussian in each part but harmonics
EXTENDED = 2  # flag of files with extensions
COORDINATES = 0xADBE0003  # type of the extension that names the axes
RIGHT_UP_BACK = 4  # axes of files without it
OUR_AXES = np.array([1, -1, 1])  # right, down, forward
LARGEST_RATIO = 40  # of what a file unpacks to; splat-transform's have 2


def read_gaussians(path: str | Path) -> Gaussians:
    """Read a file of the format that its suffix names, in our axes, with harmonics up to degree 3.

    Raises:
        PlyError: the file is missing or damaged, needs `splat-transform`, which is not installed, or has no finite
            Gaussian. A warning counts those that are not finite.
        CompleteSplatError: `splat-transform` fails.
    """
    path = Path(path)
    read = {".splat": _read_splat, ".spz": _read_spz}.get(path.suffix.lower())
    if read is None:
        packed = _packed_format(path)
        return read_ply(path) if packed is None else _read_by_splat_transform(path, packed)
    try:
        values = read(path.read_bytes())
    except (OSError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise PlyError(f"{path}: damaged, missing, or of another version ({error})") from error
    tensors = [torch.from_numpy(value.astype(np.float32)) for value in values]
    gaussians = Gaussians(*tensors[:5])
    if tensors[5:]:
        gaussians = DirectionalGaussians(**vars(gaussians), harmonics=tensors[5])
    return cleaned(gaussians, path, bounded)


def _packed_format(path: Path) -> str | None:
    """Return the name of a format that `splat-transform` unpacks, or None for one that `read_ply` reads or refuses."""
    if path.suffix.lower() in (".sog", ".ksplat"):
        return path.suffix[1:].upper()
    if not path.is_file() or not os.access(path, os.R_OK):
        return None
    with path.open("rb") as file:
        start = file.read(LONGEST_HEADER)
    return "SuperSplat's compressed PLY" if f" {PACKED}\n".encode() in start else None


def _read_by_splat_transform(path: Path, kind: str) -> Gaussians:
    program = shutil.which(PROGRAM)
    if program is None:
        advice = f"`{PROGRAM} {path.name} x.ply` unpacks it, or install {PROGRAM} to read it here"
        raise PlyError(f"{path}: {kind}; {advice}")
    with tempfile.TemporaryDirectory() as folder:
        convert(program, path.absolute(), Path(folder) / "unpacked.ply")
        return read_ply(Path(folder) / "unpacked.ply")


def _read_splat(content: bytes) -> list[np.ndarray]:
    records = np.frombuffer(content, RECORD)
    colors = records["colors"] / 255
    rotations = records["quaternions"] / 128 - 1
    # A Gaussian is the same along both directions of an axis, so the sign of an extent means nothing.
    return [records["means"], rotations, np.abs(records["scales"]), colors[:, 3], colors[:, :3]]


def _read_spz(content: bytes) -> list[np.ndarray]:
    most = max(LARGEST_RATIO * len(content), 2**24)
    data = content if content.startswith(b"NGSP") else GzipFile(fileobj=BytesIO(content)).read(most)
    magic, version, count, degree, bits, flags, streams, table = HEADER.unpack_from(data)
    ends = count * np.cumsum([*WIDTHS.get(version, ()), 3 * coefficients(degree)])
    if magic != b"NGSP" or version not in WIDTHS or degree > 4 or ends[-1] > most:
        raise ValueError(f"version {version}, {count} Gaussians, harmonics of degree {degree}")
    extensions = b""
    if version == 4:
        if flags & EXTENDED:
            extensions = data[32:table]
        sizes = np.diff(ends, prepend=0)
        body = _unpacked(data, table, streams, sizes[sizes > 0])
    else:
        body = data[16 : 16 + ends[-1]]
    blocks = np.split(np.frombuffer(body, np.uint8, ends[-1]), ends[:-1])
    positions, opacities, colors, scales, rotations = (block.reshape(count, -1) for block in blocks[:5])
    signs = _signs(extensions)
    # 24 bits of a fixed-point number in the upper part of 32
    fixed = np.pad(positions.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0))).view("<i4")[..., 0] >> 8
    arrays = [
        np.ldexp(fixed, -bits) * signs,
        _quaternions(rotations) * np.append(1, signs.prod() * signs),
        np.exp(scales / 16 - 10),
        opacities[:, 0] / 255,
        np.maximum(0.5 + SH_C0 * (colors / 255 - 0.5) / 0.15, 0),
    ]
    if degree > 0:
        values = blocks[5].reshape(count, coefficients(degree), 3)[:, : coefficients(LARGEST_DEGREE)]
        harmonics = torch.from_numpy(values / 128 - 1)
        arrays.append(rotated(harmonics, torch.from_numpy(np.diag(signs * 1.0))).numpy())
    return arrays


def _signs(extensions: bytes) -> np.ndarray:
    """Return the signs that turn the axes of a file to ours. Its extensions may name them (0 to 8)."""
    system = 0
    while len(extensions) >= 12:
        kind, size, value = struct.unpack_from("<III", extensions)
        if kind == COORDINATES:
            system = value
        extensions = extensions[8 + size :]
    if system > 8:
        raise ValueError(f"coordinate system {system}")
    right_up_front = (system or RIGHT_UP_BACK) - 1 >> np.arange(3) & 1
    return (2 * right_up_front - 1) * OUR_AXES


def _unpacked(data: bytes, table: int, streams: int, sizes: np.ndarray) -> bytes:
    """Unpack the streams of version 4, which follow a table with the packed and the unpacked size of each."""
    import pyarrow

    rows = np.frombuffer(data, "<i8", 2 * streams, table).reshape(streams, 2)[: len(sizes)]
    start = table + 16 * streams
    parts = []
    for packed_size, size in zip(rows[:, 0].tolist(), sizes.tolist(), strict=True):
        packed = data[start : start + packed_size]
        parts.append(pyarrow.decompress(packed, size, "zstd", asbytes=True))
        start += packed_size
    return b"".join(parts)


def _quaternions(packed: UInt8[np.ndarray, "gaussian bytes"]) -> Float[np.ndarray, "gaussian 4"]:
    """Unpack x, y, z of a byte each, or two bits that name the largest of x, y, z, w and ten for each other."""
    if packed.shape[1] == 3:
        fourth = np.full((len(packed), 1), 3)
        three = packed / 127.5 - 1
    else:
        word = packed.view("<u4")
        fourth = word >> 30
        fields = word >> np.array([20, 10, 0], np.uint32)
        three = np.where(fields & 512, -1, 1) * (fields & 511) * (math.sqrt(0.5) / 511)
    others = np.arange(4) != fourth
    quaternions = np.empty((len(packed), 4))
    quaternions[others] = three.ravel()
    quaternions[~others] = np.sqrt(np.maximum(0, 1 - (three**2).sum(-1)))
    return np.roll(quaternions, 1, axis=-1)
