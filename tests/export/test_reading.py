"""Files of Gaussians that other programs wrote, and damaged ones."""

import base64
import gzip
import math
import struct

import pytest
import torch

from completesplat.errors import PlyError
from completesplat.export.formats import write_splat
from completesplat.export.ply import write_ply
from completesplat.export.reading import read_gaussians
from completesplat.gaussians import Gaussians

SCENE = Gaussians(
    torch.tensor([[1.0, 2, 3], [-0.5, 0.25, 4], [0, -1, 2]]),
    torch.tensor([[0.5, 0.5, -0.5, 0.5], [0.8, 0, 0.6, 0], [0.1, 0.7, -0.1, 0.7]]),
    torch.tensor([[0.1, 0.2, 0.4], [0.05, 0.05, 0.3], [0.2, 0.1, 0.1]]),
    torch.tensor([0.9, 0.5, 0.2]),
    torch.tensor([[0.9, 0.1, 0.2], [0.2, 0.6, 0.4], [0.3, 0.3, 1.0]]),
)
# The `.ply` of SCENE, converted by npm's @playcanvas/splat-transform 2.7.1 with --spz-version 3 and 4.
CONVERTED = {
    3: "H4sIAAAAAAAAA/NzDw5gZmBgAGEGHiAWYGB48J/hwn+GH/8Z/vxnOPCfASb4rMF4m2d4eG9RSsrh6raJBQW9bdXVmUvnijGc4Dvg"
    "8aKfBQC3Ct80TAAAAA==",
    4: "TkdTUAQAAAADAAAAAAwABSAAAAAAAAAAAAAAAAAAAAAkAAAAAAAAABsAAAAAAAAADAAAAAAAAAADAAAAAAAAABIAAAAAAAAACQAA"
    "AAAAAAASAAAAAAAAAAkAAAAAAAAAFQAAAAAAAAAMAAAAAAAAACi1L/0gG9kAAAAQAADg/wDQ/wD4/wD8/wDA/wAAAAAQAADg/yi1"
    "L/0gAxkAAOaAMyi1L/0gCUkAALZJV1eNcmRkwyi1L/0gCUkAAHuGkXBwjYZ7eyi1L/0gDGEAAGmlnRYAyA7ASOiPBA==",
}


def version_2(gaussians: Gaussians, harmonics: int = 0) -> bytes:
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
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, gaussians.count, int(harmonics > 0), 12, 0, 0)
    return gzip.compress(header + b"".join(parts) + bytes(harmonics))


NAMES = ("means", "quaternions", "scales", "opacities", "colors")
FILES = {f"v{version}.spz": base64.b64decode(text) for version, text in CONVERTED.items()}
FILES |= {"v2.SPZ": version_2(SCENE), "harmonics.spz": version_2(SCENE, 3 * 9)}


def check(read: Gaussians, position: float, size: float, color: float, shape: float) -> None:
    assert torch.allclose(read.means, SCENE.means, atol=position)
    assert torch.allclose(read.scales.log(), SCENE.scales.log(), atol=size)
    assert torch.allclose(read.opacities, SCENE.opacities, atol=0.6 / 255)
    assert torch.allclose(read.colors, SCENE.colors, atol=color)
    assert torch.allclose(read.covariances(), SCENE.covariances(), atol=shape)


@pytest.mark.parametrize("name", FILES)
def test_spz_of_others_is_read_in_our_axes(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name])
    check(read_gaussians(tmp_path / name), position=1 / 8192, size=1 / 32 + 1e-4, color=0.005, shape=0.01)


def test_splat_and_ply_are_read(tmp_path):
    write_splat(tmp_path / "a.splat", SCENE)
    check(read_gaussians(tmp_path / "a.splat"), position=0, size=1e-6, color=0.6 / 255, shape=0.003)
    one = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 102, 255, 128, 128, 128)
    (tmp_path / "one.splat").write_bytes(one)
    read = read_gaussians(tmp_path / "one.splat")
    values = torch.cat([read.means[0], read.scales[0], read.colors[0], read.opacities])
    assert torch.allclose(values, torch.tensor([1, 2, 3, 0.1, 0.2, 0.3, 1, 0, 0.2, 0.4]))
    assert torch.allclose(read.quaternions, torch.tensor([[127 / 128, 0, 0, 0]]))
    write_ply(tmp_path / "a.ply", SCENE)
    check(read_gaussians(tmp_path / "a.ply"), position=0, size=1e-6, color=1e-6, shape=1e-6)


def spz(version: int = 3, count: int = 1, body: bytes = bytes(20)) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, 0) + body)


V4 = FILES["v4.spz"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.splat", bytes(33)),
        ("a.splat", struct.pack("<6f8B", math.nan, *[0] * 13)),
        ("a.spz", b""),
        ("a.spz", b"ply\n"),
        ("a.spz", spz(version=1)),
        ("a.spz", spz(count=2)),
        ("a.spz", spz(count=2**32 - 1)),
        ("a.spz", spz()[:-12]),
        ("a.spz", V4[:-20]),
        ("a.spz", V4[:8] + b"\4" + V4[9:]),  # one Gaussian more than the streams have
        ("a.spz", V4[:32] + b"\xff" * 8 + V4[40:]),  # a stream of -1 bytes
        ("a.spz", V4[:15] + b"\xff" + V4[16:]),
        ("a.ply", b"ply\n"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PlyError, match=rf"{name}: "):
        read_gaussians(tmp_path / name)


def test_no_more_is_unpacked_than_forty_times_the_file(tmp_path):
    """Sixteen million bytes are unpacked of any file."""
    bomb = spz(count=10**6, body=bytes(20 * 10**6))
    (tmp_path / "a.spz").write_bytes(bomb)
    with pytest.raises(PlyError, match="version 3, 1000000 Gaussians"):
        read_gaussians(tmp_path / "a.spz")
