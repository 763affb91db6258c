"""The files of one prediction beside its splats: contact sheet, maps and description."""

import dataclasses
import os

import numpy as np
import pytest
import torch
from fake_converter import install
from image_sheets import cells
from PIL import Image
from support import some_gaussians, strict_json

from completesplat.export import prediction
from completesplat.export.images import color_depth
from completesplat.export.ply import read_ply
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

GREY, KINDS = 128, ("depth", "normals", "opacity")


def test_every_image_stands_upright_in_its_row_and_column_below_the_title(tmp_path):
    reference, images, depths = torch.rand(3, 36, 48), torch.rand(3, 8, 3, 36, 48), torch.rand(3, 1, 36, 48)
    prediction.contact_sheet(tmp_path / "a.png", "a title", reference, images, depths)
    sheet = Image.open(tmp_path / "a.png")
    assert np.asarray(sheet)[:30].std() > 0
    above = torch.ones(3, 1, 3, 36, 48)
    above[0] = reference
    expected = torch.cat([above, images, color_depth(depths)[0][:, None]], dim=1)
    result = cells(sheet.crop((0, 30, *sheet.size)), 36, 48)
    torch.testing.assert_close(result, expected, atol=0.5 / 255 + 1e-5, rtol=0)


CAMERA = Cameras(torch.eye(4), pinhole(60, 16), (16, 16))


def scene_at(depth: float, opacity: float):
    """Two splats in one place, on the optical axis."""
    scene = some_gaussians(1, scale=0.1, opacity=opacity)[0]
    return dataclasses.replace(scene, means=torch.tensor([0.0, 0, depth]).expand(2, 3))


def test_depth_is_the_surfaces_where_it_is_opaque_and_nothing_elsewhere():
    rendering, faint = (ReferenceRasterizer()(scene_at(2, a)[None], CAMERA[None][None]) for a in (0.9, 0.2))
    depth, opaque = rendering.surface_depth(), rendering.alpha > 0.5
    assert 0 < opaque.sum() < opaque.numel()
    torch.testing.assert_close(depth, torch.where(opaque, 2.0, 0.0))
    assert faint.alpha.max() > 0.2
    assert (faint.surface_depth() == 0).all()


def test_maps_share_one_scale_of_depth_and_agree_on_what_is_there(tmp_path):
    scenes = [scene_at(1, 0.9), scene_at(4, 0.9)]
    files, (near, far) = prediction.write_maps(tmp_path, scenes, CAMERA, ReferenceRasterizer())
    assert (round(near, 3), round(far, 3)) == (1, 4)
    assert sorted(files.values()) == sorted(path.name for path in tmp_path.iterdir())
    assert set(files) == {f"{kind}_{index:02}" for kind in KINDS for index in (0, 1)}
    for index in (0, 1):
        depth, normals, opacity = (np.asarray(Image.open(tmp_path / f"{kind}_{index:02}.png")) for kind in KINDS)
        assert depth[8, 8].max() < 60 if index else depth[8, 8].min() > 150  # the darkest and the brightest colour
        there = opacity[..., 0] > 127
        assert (opacity == opacity[..., :1]).all()
        assert 0 < there.sum() < there.size
        assert (depth[~there] == GREY).all()
        assert (normals[~there] == GREY).all()
        # The splat is flat to the camera: light blue.
        assert np.abs(normals[8, 8].astype(int) - [128, 128, 255]).max() <= 1


def test_the_camera_comes_back_exactly_and_numbers_that_are_not_finite_leave_the_old_file(tmp_path):
    oblong, path, settings = Cameras(torch.eye(4), pinhole(50.0, 64), (64, 48)), tmp_path / "s.json", {"steps": 50}
    prediction.write_scene_json(path, oblong, settings, 7, {"splat": "größe.ply"})
    with pytest.raises(ValueError, match="JSON"):
        prediction.write_scene_json(path, oblong, {"weight": torch.inf}, 0, {})
    scene = strict_json(path)
    stored = scene["reference_camera"]
    assert torch.equal(torch.tensor(stored["world_to_camera"]), oblong.world_to_camera)
    assert torch.equal(torch.tensor(stored["intrinsics"]), oblong.intrinsics)
    assert stored["image_size"] == [64, 48]
    assert (scene["settings"], scene["seed"], scene["files"]) == (settings, 7, {"splat": "größe.ply"})
    assert {"axes", "units", "quaternions", "colors"} <= set(scene["conventions"])
    assert list(tmp_path.iterdir()) == [path]


def test_colours_that_are_clipped_and_what_spz_leaves_out_are_counted(tmp_path, monkeypatch):
    program = install(tmp_path / "bin", "splat-transform")
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    bright = dataclasses.replace(scene_at(2, 0.9), colors=torch.tensor([[0.2, 0.4, 1.5], [0.0, 0.5, 1.0]]))
    faint = dataclasses.replace(scene_at(2, 0.9), opacities=torch.tensor([0.9, 1e-4]))
    wanted = prediction.OutputFiles(formats=("ply", "spz"), videos=())
    shots, settings = [prediction.Shot(bright, CAMERA), prediction.Shot(faint, CAMERA)], {"seed": 0, "image": "a.png"}
    prediction.write_prediction(tmp_path / "a", torch.zeros(3, 16, 16), shots, ReferenceRasterizer(), wanted, settings)
    recorded = strict_json(tmp_path / "a/scene.json")["settings"]
    counted = [recorded[name] for name in ("gaussians", "colors_clipped", "left_out_of_spz")]
    assert counted == [[2, 2], [1, 0], [0, 1]]
    assert [read_ply(tmp_path / f"a/sample_{i:02}.spz").count for i in (0, 1)] == [2, 1]


@pytest.mark.parametrize(("far", "offset"), [((300.0, -200.0, 100.0), [0, 0, 0]), ((4e5, 5e6, 300.0), [4e5, 5e6, 300])])
def test_files_have_the_users_coordinates_or_those_less_an_offset_that_scene_json_has(tmp_path, caplog, far, offset):
    places = torch.tensor([[0.25, 0.5, 2.0], [-0.25, 0, 2.0]])
    scene = dataclasses.replace(scene_at(2, 0.9), means=places)
    images = torch.zeros(1, 3, 16, 16)
    shot = prediction.Shot(scene, CAMERA, units=prediction.FileUnits(0.5, far))  # exact in float32
    prediction.write_fitted_scene(tmp_path, "a", "a", shot, images, images, 0)
    recorded = strict_json(tmp_path / "scene.json")
    assert recorded["settings"].get("offset", [0, 0, 0]) == offset
    assert caplog.text.count("a: too far from its origin for float32: add offset (400000, 5e+06, 300)") == any(offset)
    stored = read_ply(tmp_path / "scene.ply").means
    user = stored.double().numpy() + offset
    np.testing.assert_allclose(user, 2 * places.double().numpy() + far, rtol=0, atol=1e-12)
    camera = torch.tensor(recorded["reference_camera"]["world_to_camera"])
    torch.testing.assert_close(stored @ camera[:3, :3].T + camera[:3, 3], 2 * places)
