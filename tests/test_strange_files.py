"""Gaussians of other programs, each with its right value; what is damaged is in `test_damaged_files`."""

import logging
from pathlib import Path

import fake_converter
import numpy as np
import pytest
import torch
from splats_of_others import COMPRESSED, DIRECTIONAL_FILES, SCENE, spz_with_axes

from completesplat.errors import CompleteSplatError
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.reading import read_gaussians
from completesplat.export.splat import RECORD
from completesplat.geometry.cameras import Cameras
from completesplat.viewer.sample import read_scene

# Signs that turn stored axes to ours: +x right, +y down, +z forward.
AXES = {0: (1, -1, -1), 1: (-1, 1, -1), 3: (-1, -1, -1), 4: (1, -1, -1), 6: (1, 1, 1), 7: (-1, -1, 1)}


@pytest.mark.parametrize("system", AXES)
def test_the_axes_that_an_spz_names_are_turned_to_ours(tmp_path, system):
    (tmp_path / "a.spz").write_bytes(spz_with_axes(system))
    read = read_gaussians(tmp_path / "a.spz")
    flip = torch.tensor(AXES[system]) * torch.tensor([1.0, -1, -1])
    (tmp_path / "usual.spz").write_bytes(DIRECTIONAL_FILES["v4.spz"])
    usual = read_gaussians(tmp_path / "usual.spz")
    seen_from = torch.tensor([0.3, -2.0, 0.5])
    assert torch.allclose(read.seen_from(seen_from * flip).colors, usual.seen_from(seen_from).colors, atol=1e-5)
    assert torch.allclose(read.means, SCENE.means * flip, atol=1 / 8192)
    assert torch.allclose(read.covariances(), flip[:, None] * SCENE.covariances() * flip, atol=0.01)


PACKED = {
    "a.sog": b"PK\3\4",
    "a.KSPLAT": b"\0\1",
    "a.ply": COMPRESSED,
}


@pytest.mark.parametrize("name", PACKED)
def test_packed_formats_are_read_through_splat_transform(tmp_path, monkeypatch, name):
    path = tmp_path / name
    path.write_bytes(PACKED[name])
    write_ply(tmp_path / "truth.ply", SCENE)
    script = f'for last; do :; done\ncp {tmp_path / "truth.ply"} "$last"\n'
    fake_converter.install(tmp_path / "bin", "splat-transform", script)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    assert torch.equal(read_gaussians(path).means, SCENE.means)


def test_read_ply_names_the_compressed_format(tmp_path):
    (tmp_path / "a.ply").write_bytes(COMPRESSED)
    reason = r"a\.ply: SuperSplat's compressed PLY; `splat-transform FILE x\.ply` un"
    with pytest.raises(CompleteSplatError, match=reason):
        read_ply(tmp_path / "a.ply")


def splat(path: Path, factor: float = 1.0, broken: int = 0) -> None:
    """Write 50 Gaussians as `.splat`, the first of them not finite."""
    records = np.zeros(50, RECORD)
    records["means"] = factor * np.random.default_rng(0).normal(size=(50, 3))
    records["scales"] = 0.1
    records["colors"] = 200
    records["quaternions"] = 200
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


def test_gaussians_that_renderers_can_just_square_are_shown(tmp_path):
    splat(tmp_path / "a.splat", factor=1e17)
    samples, _ = read_scene(tmp_path / "a.splat")
    assert isinstance(samples[0].reference, Cameras)
    assert samples[0].pivot().isfinite().all()
