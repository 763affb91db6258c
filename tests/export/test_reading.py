"""Files of Gaussians that other programs wrote."""

import gzip
import struct

import pytest
import torch
from splats_of_others import DIRECTIONAL, DIRECTIONAL_FILES, FILES, SCENE

from completesplat.errors import PlyError
from completesplat.export.ply import write_ply
from completesplat.export.reading import read_gaussians
from completesplat.export.splat import write_splat
from completesplat.gaussians import Gaussians


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


@pytest.mark.parametrize("name", DIRECTIONAL_FILES)
def test_harmonics_of_spz_are_read_as_exactly_as_they_are_stored(tmp_path, name):
    (tmp_path / name).write_bytes(DIRECTIONAL_FILES[name])
    read = read_gaussians(tmp_path / name)
    check(read, position=1 / 8192, size=1 / 32 + 1e-4, color=0.005, shape=0.01)
    error = (read.harmonics - DIRECTIONAL.harmonics).abs()  # five bits for degree 1, four for the others
    assert error[:, :3].max() <= 1 / 32 + 1e-6
    assert error[:, 3:].max() <= 1 / 16 + 1e-6


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


def spz(version: int = 3, count: int = 1, body: bytes = bytes(20), degree: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0) + body, mtime=0)


def test_no_more_is_unpacked_than_forty_times_the_file(tmp_path):
    """Sixteen million bytes are unpacked of any file."""
    bomb = spz(count=10**6, body=bytes(20 * 10**6))
    (tmp_path / "a.spz").write_bytes(bomb)
    with pytest.raises(PlyError, match="version 3, 1000000 Gaussians"):
        read_gaussians(tmp_path / "a.spz")
