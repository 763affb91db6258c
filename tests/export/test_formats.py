"""Files of a scene, written by a stand-in for the converter; initial view of a page."""

import json
import os
import struct
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from fake_converter import COPY, calls, install
from gsply import plyread, read_spz
from support import some_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.export.formats import FORMATS, write_format
from completesplat.export.gltf import write_glb
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.splat import write_splat
from completesplat.export.splat_transform import PageView, upright_rotation, viewer_settings
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.geometry.harmonics import SH_C0
from completesplat.geometry.rotations import normalize_quaternion

UP = torch.tensor([0.1, -0.9, -0.4])
PIVOT = torch.tensor([0.0, 0.0, 2.5])
VIEW = PageView(Cameras(torch.eye(4), pinhole(50, 64), (64, 64)), PIVOT, UP, 0.25)
SPLATS = [kind for kind in FORMATS if kind != "mesh"]
# Also keeps the settings of a page, whose folder is gone afterwards.
KEEP_SETTINGS = f'{COPY}[ "$3" = --viewer-settings ] && cp "$4" "$0.settings" || true\n'


@pytest.fixture
def program(tmp_path, monkeypatch):
    program = install(tmp_path / "bin", "splat-transform", KEEP_SETTINGS)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    return program


@pytest.mark.parametrize("formats", [["splat"], SPLATS])
def test_the_formats_that_are_wanted_are_written_and_no_others(tmp_path, program, monkeypatch, formats):
    out = tmp_path / "out"
    scene = some_gaussians(1)[0]
    out.mkdir()
    files = {}
    for kind in formats:
        files |= write_format(out, "sample_00", kind, scene, VIEW)
    assert sorted(files.values()) == sorted(path.name for path in out.iterdir())
    assert set(files) == {"sample_00" if kind == "ply" else f"sample_00_{kind}" for kind in formats}
    needed = set(formats) & {"sog", "html"}
    assert calls(program)[:1] == ["--version"][: len(needed)]
    assert len(calls(program)[1:]) == len(needed)
    monkeypatch.setenv("PATH", str(out))
    for kind in formats:
        with pytest.raises(CompleteSplatError, match=r"need Node\.js") if kind in needed else nullcontext():
            write_format(out, "other", kind, scene, VIEW)


def test_all_formats_but_the_page_are_made_of_the_ply_itself(tmp_path, program):
    scene = some_gaussians(1)[0]
    scene.means[:] = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    for kind in ("ply", "sog", "html"):
        write_format(tmp_path, "a", kind, scene, VIEW)
    write_ply(tmp_path / "turned.ply", scene.transform(upright_rotation(UP)))
    names = "a.ply", "a.sog", "a.html", "turned.ply"
    ply, sog, html, turned = ((tmp_path / name).read_bytes() for name in names)
    assert sog == ply
    assert html == turned != ply


def test_colours_are_clipped_alike_in_all_formats_but_ply(tmp_path, program):
    scene = replace(some(), opacities=torch.full((20,), 0.5))
    for kind in SPLATS:
        write_format(tmp_path, "a", kind, scene, VIEW)
    clipped = scene.colors.clamp(0, 1)
    assert not torch.equal(clipped, scene.colors)
    torch.testing.assert_close(read_ply(tmp_path / "a.ply").colors, scene.colors.clamp(min=0), rtol=0, atol=1e-6)
    # The converter's stand-in copies what it is given.
    torch.testing.assert_close(read_ply(tmp_path / "a.sog").colors, clipped, rtol=0, atol=1e-6)
    for stored in (read_spz(tmp_path / "a.spz"), plyread(tmp_path / "a.compressed.ply")):
        colors = torch.from_numpy(stored.sh0) * SH_C0 + 0.5
        assert colors.max() <= 1 + 1e-2
        torch.testing.assert_close(colors.sum(0), clipped.sum(0), rtol=0, atol=20 / 255)
    write_glb(tmp_path / "other.glb", replace(scene, colors=clipped))
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "other.glb").read_bytes()
    write_splat(tmp_path / "other.splat", scene)
    assert (tmp_path / "a.splat").read_bytes() == (tmp_path / "other.splat").read_bytes()


def test_spz_goes_without_opacities_that_round_to_nothing(tmp_path):
    """An opacity of 0 in 8 bits would be read as a logit of minus infinity."""
    opacities = torch.tensor([0.5 / 255 - 1e-6, 0.0, 1.0, 0.6 / 255] * 5)
    for kind in ("ply", "spz"):
        write_format(tmp_path, "a", kind, replace(some(), opacities=opacities), VIEW)
    assert read_ply(tmp_path / "a.ply").count == 20
    opacities_there = torch.from_numpy(read_spz(tmp_path / "a.spz").opacities).sigmoid()
    torch.testing.assert_close(opacities_there, torch.tensor([1.0, 1 / 255] * 5), rtol=0, atol=1e-3)
    with pytest.raises(CompleteSplatError, match=r"b.spz: all 20 Gaussians are transparent"):
        write_format(tmp_path, "b", "spz", replace(some(), opacities=opacities / 1000), VIEW)


@pytest.mark.parametrize("up", [[0.1, -0.9, -0.4], [0.0, 0.0, -1.0], [0.0, 0.0, 3.0], [1.0, 0.0, 0.0]])
def test_a_scene_is_turned_until_up_points_to_minus_y(up):
    turn = upright_rotation(torch.tensor(up))[:3, :3]
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(turn), torch.tensor(1.0))
    direction = torch.tensor(up) / torch.tensor(up).norm()
    torch.testing.assert_close(turn @ direction, torch.tensor([0.0, -1, 0]), rtol=0, atol=1e-6)
    assert abs(turn[0, 2]) < 1e-6  # what is in front stays in front
    assert turn[2, 2] > -1e-6


def test_a_page_begins_at_the_reference_camera_and_shows_its_whole_image(tmp_path, program):
    write_format(tmp_path, "a", "html", some_gaussians(1)[0], VIEW)
    settings = json.loads((tmp_path / "bin/splat-transform.settings").read_text())
    assert settings == json.loads(json.dumps(viewer_settings(VIEW, upright_rotation(UP))))
    initial = settings["cameras"][0]["initial"]
    # The viewer's +y points up: the pivot is as much below the camera as the scene's up leans to the viewer.
    target = torch.tensor(initial["target"])
    assert set(initial["position"]) == {0}
    torch.testing.assert_close(target.norm(), PIVOT.norm())
    torch.testing.assert_close(target[1], PIVOT @ UP / UP.norm())
    assert settings["background"] == {"color": [0.25] * 3}
    half_of_short_side = torch.tensor(initial["fov"]).div(2).deg2rad().tan() * 9 / 20  # fov: of the longer side
    torch.testing.assert_close(half_of_short_side, torch.tensor(25.0).deg2rad().tan())


def some(count: int = 20) -> Gaussians:
    """Return quaternions of any length, and colours and opacities at the ends of their ranges and beyond."""
    generator = torch.Generator().manual_seed(0)
    means, quaternions, scales, rest = (torch.rand(count, n, generator=generator) for n in (3, 4, 3, 4))
    rest[0], rest[1] = torch.tensor([-0.5, 0, 1, 0]), torch.tensor([1.5, 1, 0, 1])
    return Gaussians(means * 8 - 4, normalize_quaternion(quaternions * 2 - 1) * 3, scales, rest[:, 3], rest[:, :3])


def test_a_record_holds_position_extent_colour_and_rotation(tmp_path):
    gaussians = some()
    gaussians.quaternions[0] = torch.tensor([3.0, 0, 0, 0])
    gaussians.means[19, 1] = torch.nan
    assert write_splat(tmp_path / "a.splat", gaussians) == 19
    records = list(struct.iter_unpack("<6f8B", (tmp_path / "a.splat").read_bytes()))
    assert len(records) == 19
    for i, record in enumerate(records):
        assert torch.equal(torch.tensor(record[:3]), gaussians.means[i])
        assert torch.equal(torch.tensor(record[3:6]), gaussians.scales[i])
        color = torch.cat([gaussians.colors[i], gaussians.opacities[i, None]]).clamp(0, 1)
        torch.testing.assert_close(torch.tensor(record[6:10]) / 255, color, rtol=0, atol=0.5 / 255 + 1e-6)
        quaternion = (torch.tensor(record[10:]) - 128) / 128
        torch.testing.assert_close(quaternion, gaussians.quaternions[i] / 3, rtol=0, atol=1 / 128)
    assert records[0][10:] == (255, 128, 128, 128)
