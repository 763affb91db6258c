"""The files of one prediction beside its splats: contact sheet, maps and description."""

import dataclasses

import numpy as np
import torch
from gsply import read_spz
from image_sheets import cells
from PIL import Image
from support import some_gaussians, strict_json

from completesplat.export import prediction
from completesplat.export.images import color_depth
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.scene_files import OutputFiles
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


def test_colours_that_are_clipped_and_what_spz_leaves_out_are_counted(tmp_path):
    bright = dataclasses.replace(scene_at(2, 0.9), colors=torch.tensor([[0.2, 0.4, 1.5], [0.0, 0.5, 1.0]]))
    faint = dataclasses.replace(scene_at(2, 0.9), opacities=torch.tensor([0.9, 1e-4]))
    wanted = OutputFiles(formats=("ply", "spz"), videos=())
    samples, settings = [PlacedScene(bright, CAMERA), PlacedScene(faint, CAMERA)], {"seed": 0, "image": "a.png"}
    image = torch.zeros(3, 16, 16)
    prediction.write_prediction(tmp_path / "a", image, samples, ReferenceRasterizer(), wanted, settings)
    recorded = strict_json(tmp_path / "a/scene.json")["settings"]
    counted = [recorded[name] for name in ("gaussians", "colors_clipped", "left_out_of_spz")]
    assert counted == [[2, 2], [1, 0], [0, 1]]
    assert [len(read_spz(tmp_path / f"a/sample_{i:02}.spz")) for i in (0, 1)] == [2, 1]
