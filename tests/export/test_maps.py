"""Maps of a single splat before nothing."""

import numpy as np
import torch
from PIL import Image
from support import some_gaussians

from completesplat.export.pictures import surface_depth, write_maps
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

GREY = 128


def camera() -> Cameras:
    return Cameras(torch.eye(4), pinhole(60, 16), (16, 16))


def scene_at(depth: float, opacity: float):
    """Two splats in one place, on the optical axis."""
    scene = some_gaussians(1, scale=0.1, opacity=opacity)[0]
    return type(scene)(
        torch.tensor([0.0, 0, depth]).expand(2, 3), scene.quaternions, scene.scales, scene.opacities, scene.colors
    )


def read(folder, name: str) -> np.ndarray:
    return np.asarray(Image.open(folder / f"{name}.png"))


def test_depth_is_the_surfaces_where_it_is_opaque_and_nothing_elsewhere():
    rendering = ReferenceRasterizer()(scene_at(2, 0.9)[None], camera()[None][None])
    depth = surface_depth(rendering)
    opaque = rendering.alpha > 0.5
    assert opaque.any()
    assert not opaque.all()
    torch.testing.assert_close(depth[opaque], torch.full_like(depth[opaque], 2))
    assert (depth[~opaque] == 0).all()


def test_what_shines_through_has_no_depth():
    rendering = ReferenceRasterizer()(scene_at(2, 0.2)[None], camera()[None][None])
    assert rendering.alpha.max() > 0.2
    assert (surface_depth(rendering) == 0).all()


def test_scenes_share_one_scale_of_depth(tmp_path):
    files, (near, far) = write_maps(tmp_path, [scene_at(1, 0.9), scene_at(4, 0.9)], camera(), ReferenceRasterizer())
    assert (round(near, 3), round(far, 3)) == (1, 4)
    assert sorted(files.values()) == sorted(path.name for path in tmp_path.iterdir())
    assert set(files) == {f"{kind}_{index:02}" for kind in ("depth", "normals", "opacity") for index in (0, 1)}
    close, distant = (read(tmp_path, f"depth_{index:02}")[8, 8] for index in (0, 1))
    assert close.min() > 150  # the brightest colour
    assert distant.max() < 60  # the darkest


def test_pictures_agree_on_what_is_there(tmp_path):
    write_maps(tmp_path, [scene_at(2, 0.9)], camera(), ReferenceRasterizer())
    depth, normals, opacity = (read(tmp_path, f"{kind}_00") for kind in ("depth", "normals", "opacity"))
    there = opacity[..., 0] > 127
    assert (opacity == opacity[..., :1]).all()
    assert 0 < there.sum() < there.size
    assert (depth[~there] == GREY).all()
    assert (normals[~there] == GREY).all()
    # The splat is flat to the camera: light blue.
    assert np.abs(normals[8, 8].astype(int) - [128, 128, 255]).max() <= 1
