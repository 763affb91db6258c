"""Files of Gaussians as other programs write them."""

import base64
import gzip
import math
import struct

import torch

from completesplat.gaussians import DirectionalGaussians, Gaussians

NAMES = ("means", "quaternions", "scales", "opacities", "colors")
SCENE = Gaussians(
    torch.tensor([[1.0, 2, 3], [-0.5, 0.25, 4], [0, -1, 2]]),
    torch.tensor([[0.5, 0.1, -0.7, 0.3], [0.8, -0.2, 0.5, 0.1], [0.1, 0.6, -0.3, 0.7]]),
    torch.tensor([[0.1, 0.2, 0.4], [0.05, 0.1, 0.3], [0.3, 0.1, 0.02]]),
    torch.tensor([0.9, 0.5, 0.2]),
    torch.tensor([[0.9, 0.1, 0.2], [0.2, 0.6, 0.4], [0.3, 0.3, 1.0]]),
)
HARMONICS = (torch.arange(3 * 15 * 3) * 7 % 16 / 16 - 0.5).unflatten(0, (3, 15, 3))
DIRECTIONAL = DirectionalGaussians(**vars(SCENE), harmonics=HARMONICS)
# The `.ply` of SCENE, converted by npm's @playcanvas/splat-transform 2.7.1 with --spz-version 3 and 4.
CONVERTED = {
    3: "H4sIAAAAAAAAA/NzDw5gZmBgAGEGHiAWYGB48J/hwn+GH/8Z/vxnOPCfASb4rMF4m2d4eG9RSsrh6raJBdW9vdWJXVt/u3hfi33p"
    "VXV7NwDn7BMUTAAAAA==",
    4: "TkdTUAQAAAADAAAAAAwABSAAAAAAAAAAAAAAAAAAAAAkAAAAAAAAABsAAAAAAAAADAAAAAAAAAADAAAAAAAAABIAAAAAAAAACQAA"
    "AAAAAAASAAAAAAAAAAkAAAAAAAAAFQAAAAAAAAAMAAAAAAAAACi1L/0gG9kAAAAQAADg/wDQ/wD4/wD8/wDA/wAAAAAQAADg/yi1"
    "L/0gAxkAAOaAMyi1L/0gCUkAALZJV1eNcmRkwyi1L/0gCUkAAHuGkXB7jY17YSi1L/0gDGEAAIq1+0RL1l3pSnrbuw==",
}


def version_2(gaussians: Gaussians) -> bytes:
    """Encode as Niantic's document of the format says: +y up, +z back; all parts one after another, gzipped."""
    parts = [b""] * 5
    for mean, q, scales, opacity, color in zip(*(getattr(gaussians, name).tolist() for name in NAMES), strict=True):
        length = math.sqrt(sum(x * x for x in q)) * (1 if q[0] > 0 else -1)
        turned = mean[0], -mean[1], -mean[2]
        parts[0] += b"".join(round(x * 4096).to_bytes(3, "little", signed=True) for x in turned)
        parts[1] += bytes([round(opacity * 255)])
        parts[2] += bytes(round(((c - 0.5) / 0.28209479 * 0.15 + 0.5) * 255) for c in color)
        parts[3] += bytes(round((math.log(s) + 10) * 16) for s in scales)
        # Turning axes by half a turn about x turns y and z of a rotation's axis, too.
        parts[4] += bytes(round((x / length + 1) * 127.5) for x in (q[1], -q[2], -q[3]))
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, gaussians.count, 0, 12, 0, 0)
    return gzip.compress(header + b"".join(parts))


FILES = {f"v{version}.spz": base64.b64decode(text) for version, text in CONVERTED.items()}
FILES["v2.SPZ"] = version_2(SCENE)
# The same of DIRECTIONAL.
DIRECTIONAL_FILES = {
    "v3.spz": "H4sIAAAAAAAAA02NrwoCQRCHB6wG38UXuCD4D2TAcFeEES5cXEyHVzaJCAtrM040TtFiWfAFTBaLSfANBIV1PBEMM/Cb38c3o+4Y"
    "GwBQT1NXC+Aa4RThEeEVIUT4HW+2ve+nqZvl+bFarE3lXDVd7Z6d4XlyH8wvh7DEDW19z6InYvSJRSbyqFmIxQaPzOSDRSNUSKl8wZkJNmhm"
    "1F4MS52JjfJWDIn5FBkrn5TCJOpTXvt/v/L67+t/AwXlKAPTAAAA",
    "v4.spz": "TkdTUAQAAAADAAAAAwwABiAAAAAAAAAAAAAAAAAAAAAkAAAAAAAAABsAAAAAAAAADAAAAAAAAAADAAAAAAAAABIAAAAAAAAACQAA"
    "AAAAAAASAAAAAAAAAAkAAAAAAAAAFQAAAAAAAAAMAAAAAAAAAF8AAAAAAAAAhwAAAAAAAAAotS/9IBvZAAAAEAAA4P8A0P8A+P8A/P8AwP8A"
    "AAAAEAAA4P8otS/9IAMZAADmgDMotS/9IAlJAAC2SVdXjXJkZMMotS/9IAlJAAB7hpFwe42Ne2EotS/9IAxhAACKtftES9Zd6Up627sotS/9"
    "IIe1AgCyRxMUwCUdu0QmkUlkUn1imOgTma+qiwOdrYqK3ulzRP38QQwfFjoifryMnB5HhjffEXnnyFDwUGCGj52S6Wx15N4rUTdLROWtEkAH"
    "EygwAQEA78iFKA==",
}
DIRECTIONAL_FILES = {name: base64.b64decode(text) for name, text in DIRECTIONAL_FILES.items()}


def spz_with_axes(system: int) -> bytes:
    """Return DIRECTIONAL as version 4 with the extension that names the axes of the stored values."""
    content = bytearray(DIRECTIONAL_FILES["v4.spz"])
    content[14] |= 2
    content[16:20] = (32 + 20 + 12).to_bytes(4, "little")
    unknown = struct.pack("<II12s", 0xDEAD0001, 12, b"")
    return bytes(content[:32] + unknown + struct.pack("<III", 0xADBE0003, 4, system) + content[32:])


COMPRESSED = b"""ply
format binary_little_endian 1.0
element chunk 0
property float min_x
element vertex 0
property uint packed_position
end_header
"""
