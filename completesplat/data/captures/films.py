"""Splitting of films into frames with square pixels, in sRGB.

A film says how its numbers become colours: the matrix of its luma (BT.601, BT.709, BT.2020), its primaries, and its
transfer function. A JPEG always has BT.601 and, to programs that ignore profiles, sRGB.
"""

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from completesplat.errors import DataError
from completesplat.photo import files

MATRICES = {"bt709": "bt709", "bt2020nc": "bt2020", "bt2020c": "bt2020", "smpte240m": "smpte240m", "fcc": "fcc"}
"""Names of ffmpeg's filter `scale` for the matrices that its frames have; others are those of BT.601."""
ZSCALE = {"bt709": "709", "bt2020nc": "2020_ncl", "bt2020c": "2020_cl", "unknown": "2020_ncl"}
"""Names of ffmpeg's filter `zscale` for the same, in films of wide primaries."""
UNNAMED = ("unknown", "reserved", "unspecified")
HIGH_DEFINITION = 720  # lines from which on players take a film that names no matrix for BT.709
WIDE = ("bt2020", "smpte431", "smpte432")  # primaries
HDR = ("smpte2084", "arib-std-b67")  # PQ and HLG
WHITE_NITS = 203.0  # diffuse white of PQ and HLG (ITU-R BT.2408); what is brighter is white
HLG_PEAK_NITS = 1000.0
HLG_GAMMA = 1.2  # of a display with this peak (BT.2100)
LUMINANCE = np.array([0.2627, 0.6780, 0.0593])  # of BT.2020's primaries
TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])  # BT.2087
TABLE_SIDE = 49
TABLE = "hdr.cube"


class Colors(NamedTuple):
    """Size and colours of a film's frames, in ffmpeg's words."""

    height: int
    matrix: str
    primaries: str
    transfer: str


def split_video(video: Path, images: Path, frames: int) -> None:
    """Write the first frame of each of equal parts of a video, or all frames if there are fewer, as JPEGs in sRGB.

    ffmpeg chooses the stream, which is no cover picture if there is another.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    limit = "-max_pixels", str(files.MOST_PIXELS)  # else a small file could take gigabytes
    start = [get_ffmpeg_exe(), "-nostdin", *limit, "-i", str(video.absolute()), "-an", "-sn", "-dn"]
    nowhere = ["-fps_mode", "passthrough", "-f", "null", "-"]
    output = subprocess.run([*start, *nowhere], capture_output=True).stderr
    count = int((re.findall(rb"frame= *(\d+)", output) or [b"0"])[-1])
    if not count:
        raise DataError(f"ffmpeg finds no video of at most {files.MOST_PIXELS:,} pixels there", str(video))
    first = [*start, "-vf", "showinfo", "-frames:v", "1", *nowhere]
    colors = _colors_in(subprocess.run(first, capture_output=True, text=True, errors="replace").stderr)
    part = f"{min(frames, count)}/{count}"
    filters = [f"select=gt(floor(n*{part})\\,floor((n-1)*{part}))", *_filters(colors)]
    options = ["-vf", ",".join(filters), "-fps_mode", "passthrough", "-q:v", "2"]
    table = images / TABLE
    try:
        if colors.transfer in HDR:
            table.write_text(_table(colors.transfer))
        failed = subprocess.run([*start, "-v", "error", *options, "%05d.jpg"], cwd=images).returncode
    finally:
        table.unlink(missing_ok=True)
    if failed:
        raise DataError("ffmpeg cannot split it; the reason is above", str(video))


def _colors_in(output: str) -> Colors:
    """Read the colours of a frame in what ffmpeg's filter `showinfo` prints."""

    def named(key: str) -> str:
        match = re.search(rf"\b{key}:(\S+)", output)
        return "unknown" if match is None else match[1]

    size = re.search(r"showinfo.* s:\d+x(\d+)", output)
    height = 0 if size is None else int(size[1])
    return Colors(height, named("color_space"), named("color_primaries"), named("color_trc"))


def _filters(colors: Colors) -> Sequence[str]:
    """Return filters that make a frame's pixels square and its colours those of a JPEG in sRGB."""
    matrix = MATRICES.get(colors.matrix, "bt601")
    if colors.matrix in UNNAMED:
        matrix = "bt709" if colors.height >= HIGH_DEFINITION else "bt601"
    depth = "gbrp"
    table = []
    to_bt709 = []
    if colors.transfer in HDR:
        matrix = "bt2020"
        depth = "gbrp10le"
        table = [f"lut3d=file={TABLE}:interp=tetrahedral"]
    elif colors.primaries in WIDE:
        to_bt709 = [f"zscale=min={ZSCALE.get(colors.matrix, '170m')}:tin=bt709:t=bt709:p=bt709:m=bt709"]
        matrix = "bt709"
    exact = "flags=bicubic+accurate_rnd+full_chroma_int"
    # Only by way of RGB does `scale` change the matrix.
    to_rgb = f"scale=w=max(1\\,round(iw*sar)):h=ih:in_color_matrix={matrix}:{exact},setsar=1,format={depth}"
    to_jpeg = f"scale=out_color_matrix=bt601:out_range=full:{exact},format=yuvj420p"
    return [*to_bt709, to_rgb, *table, to_jpeg]


def _table(transfer: str) -> str:
    """Return a table for ffmpeg's filter `lut3d` that turns BT.2020 with PQ or HLG to sRGB (ITU-R BT.2100)."""
    axis = np.linspace(0, 1, TABLE_SIDE)
    blue, green, red = np.meshgrid(axis, axis, axis, indexing="ij")  # red changes fastest
    values = np.stack([red, green, blue], axis=-1).reshape(-1, 3)
    nits = _pq_nits(values) if transfer == "smpte2084" else _hlg_nits(values)
    linear = (nits / WHITE_NITS @ TO_BT709.T).clip(0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    rows = "\n".join(f"{r:.6f} {g:.6f} {b:.6f}" for r, g, b in srgb.tolist())
    return f"LUT_3D_SIZE {TABLE_SIDE}\n{rows}\n"


def _pq_nits(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the light of a display for values of PQ."""
    power = values ** (1 / 78.84375)
    base = (power - 0.8359375).clip(0) / (18.8515625 - 18.6875 * power)
    light: Float[np.ndarray, "n 3"] = 10000 * base ** (1 / 0.1593017578125)
    return light


def _hlg_nits(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the light of a display of 1,000 nits for values of HLG."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(values <= 0.5, values**2 / 3, (np.exp((values - c) / a) + b) / 12)
    luminance = (scene @ LUMINANCE)[:, None]
    light: Float[np.ndarray, "n 3"] = HLG_PEAK_NITS * luminance ** (HLG_GAMMA - 1) * scene
    return light
