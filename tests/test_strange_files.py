"""Files of strangers: predictions' descriptions, and Gaussians of other programs, each with its right value."""

import logging
import struct
from pathlib import Path

import fake_converter
import numpy as np
import pytest
import torch
from splats_of_others import DIRECTIONAL_FILES, SCENE

from completesplat.errors import CompleteSplatError
from completesplat.export.formats import RECORD
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.reading import read_gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.viewer.sample import read_scene


def spz(system: int) -> bytes:
    """Return DIRECTIONAL as version 4 with the extension that names the axes of the stored values."""
    content = bytearray(DIRECTIONAL_FILES["v4.spz"])
    content[14] |= 2
    content[16:20] = (32 + 20 + 12).to_bytes(4, "little")
    unknown = struct.pack("<II12s", 0xDEAD0001, 12, b"")
    return bytes(content[:32] + unknown + struct.pack("<III", 0xADBE0003, 4, system) + content[32:])


# Signs that turn stored axes to ours: +x right, +y down, +z forward.
AXES = {0: (1, -1, -1), 1: (-1, 1, -1), 3: (-1, -1, -1), 4: (1, -1, -1), 6: (1, 1, 1), 7: (-1, -1, 1)}


@pytest.mark.parametrize("system", AXES)
def test_the_axes_that_an_spz_names_are_turned_to_ours(tmp_path, system):
    (tmp_path / "a.spz").write_bytes(spz(system))
    read, flip = read_gaussians(tmp_path / "a.spz"), torch.tensor(AXES[system]) * torch.tensor([1.0, -1, -1])
    (tmp_path / "usual.spz").write_bytes(DIRECTIONAL_FILES["v4.spz"])
    usual, seen_from = read_gaussians(tmp_path / "usual.spz"), torch.tensor([0.3, -2.0, 0.5])
    assert torch.allclose(read.seen_from(seen_from * flip).colors, usual.seen_from(seen_from).colors, atol=1e-5)
    assert torch.allclose(read.means, SCENE.means * flip, atol=1 / 8192)
    assert torch.allclose(read.covariances(), flip[:, None] * SCENE.covariances() * flip, atol=0.01)


def test_other_axes_are_refused(tmp_path):
    (tmp_path / "a.spz").write_bytes(spz(9))
    with pytest.raises(CompleteSplatError, match=r"a\.spz: .*coordinate system 9"):
        read_gaussians(tmp_path / "a.spz")


COMPRESSED = b"ply\nformat binary_little_endian 1.0\nelement chunk 0\nproperty float min_x\nelement vertex 0\n"
COMPRESSED += b"property uint packed_position\nend_header\n"
PACKED = {
    "a.sog": (b"PK\3\4", "SOG"),
    "a.KSPLAT": (b"\0\1", "KSPLAT"),
    "a.ply": (COMPRESSED, "SuperSplat's compressed PLY"),
}


@pytest.mark.parametrize("name", PACKED)
def test_packed_formats_are_named_with_the_program_that_unpacks_them_or_read_through_it(tmp_path, monkeypatch, name):
    content, kind = PACKED[name]
    path = tmp_path / name
    path.write_bytes(content)
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    reason = f"{name}: {kind}; `splat-transform {name} x.ply` unpacks it, or install splat-transform"
    with pytest.raises(CompleteSplatError, match=reason):
        read_gaussians(path)
    write_ply(tmp_path / "truth.ply", SCENE)
    script = f'for last; do :; done\ncp {tmp_path / "truth.ply"} "$last"\n'
    fake_converter.install(tmp_path / "bin", "splat-transform", script)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    assert torch.equal(read_gaussians(path).means, SCENE.means)


def test_read_ply_names_the_compressed_format(tmp_path):
    (tmp_path / "a.ply").write_bytes(COMPRESSED)
    with pytest.raises(
        CompleteSplatError, match=r"a\.ply: SuperSplat's compressed PLY; `splat-transform FILE x\.ply` un"
    ):
        read_ply(tmp_path / "a.ply")


def splat(path: Path, factor: float = 1.0, broken: int = 0) -> None:
    """Write 50 Gaussians as `.splat`, the first of them not finite."""
    records = np.zeros(50, RECORD)
    records["means"], records["scales"], records["colors"] = np.random.default_rng(0).normal(size=(50, 3)), 0.1, 200
    records["quaternions"] = 200
    records["means"] *= factor
    records["means"][:broken] = np.nan
    path.write_bytes(records.tobytes())


def test_gaussians_that_are_not_finite_are_left_out_and_counted(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    write_ply(tmp_path / "a.ply", SCENE)
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content[:-4] + np.float32(np.nan).tobytes())
    assert torch.equal(read_ply(tmp_path / "a.ply").means, SCENE.means[:2])
    assert caplog.messages[-1].startswith(f"{tmp_path / 'a.ply'}: left out 1 of 3 Gaussians")
    splat(tmp_path / "b.splat", broken=7)
    assert read_gaussians(tmp_path / "b.splat").count == 43
    assert caplog.messages[-1].startswith(f"{tmp_path / 'b.splat'}: left out 7 of 50 Gaussians")


def test_gaussians_farther_than_renderers_can_square_are_refused(tmp_path):
    splat(tmp_path / "a.splat", factor=1e17)
    samples, _ = read_scene(tmp_path / "a.splat")
    assert isinstance(samples[0].reference, Cameras)
    assert samples[0].pivot().isfinite().all()
    splat(tmp_path / "b.splat", factor=1e20)
    with pytest.raises(CompleteSplatError, match=r"b\.splat: all 50 Gaussians are broken"):
        read_scene(tmp_path / "b.splat")
