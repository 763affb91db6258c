"""The files of one prediction beside its splats: contact sheet, maps and description."""

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image
from support import some_gaussians, strict_json

from completesplat.export.pictures import surface_depth
from completesplat.export.prediction import SampleViews, contact_sheet, write_maps, write_scene_json
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

GREY = 128


def occurrences(sheet, image):
    """Upper left corners (row, column) where the image lies in the sheet, pixel for pixel."""
    windows = np.lib.stride_tricks.sliding_window_view(sheet[..., :3], image.shape)[:, :, 0]
    candidates = np.argwhere(
        (windows[:, :, 0, 0] == image[0, 0]).all(-1) & (windows[:, :, -1, -1] == image[-1, -1]).all(-1)
    )
    return [tuple(c) for c in candidates.tolist() if (windows[tuple(c)] == image).all()]


def as_pixels(image, factor):
    pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
    return pixels.repeat(factor, axis=0).repeat(factor, axis=1)


@pytest.fixture
def rows():
    draws = torch.Generator().manual_seed(0)
    pictures = [(torch.rand(8, 3, 36, 48, generator=draws), torch.rand(1, 36, 48, generator=draws)) for _ in range(3)]
    return [SampleViews(f"sample {i}", images, depth + 1) for i, (images, depth) in enumerate(pictures)]


def test_every_image_stands_upright_in_its_row_and_column(tmp_path, rows):
    reference = torch.rand(3, 36, 48)
    contact_sheet(tmp_path / "a.png", "title", reference, rows, [45.0 * i for i in range(8)])
    sheet = np.asarray(Image.open(tmp_path / "a.png"))
    (corner,) = occurrences(sheet, as_pixels(reference, 3))
    corners = np.array([[occurrences(sheet, as_pixels(image, 3))[0] for image in row.images] for row in rows])
    assert corners.shape == (3, 8, 2)
    assert (corners[:, :, 0] == corners[:, :1, 0]).all()
    assert (corners[:, :, 1] == corners[:1, :, 1]).all()
    assert (np.diff(corners[:, 0, 0]) > 36 * 3).all()
    assert (np.diff([corner[1], *corners[0, :, 1]]) > 48 * 3).all()
    assert corner[0] == corners[0, 0, 0]
    # Depth is the last column, and nothing is cut off at the right or below.
    assert sheet.shape[1] > corners[0, -1, 1] + 2 * 48 * 3
    assert sheet.shape[0] >= corners[-1, 0, 0] + 36 * 3


CAMERA = Cameras(torch.eye(4), pinhole(60, 16), (16, 16))


def scene_at(depth: float, opacity: float):
    """Two splats in one place, on the optical axis."""
    scene = some_gaussians(1, scale=0.1, opacity=opacity)[0]
    return dataclasses.replace(scene, means=torch.tensor([0.0, 0, depth]).expand(2, 3))


def read(folder, name: str) -> np.ndarray:
    return np.asarray(Image.open(folder / f"{name}.png"))


def test_depth_is_the_surfaces_where_it_is_opaque_and_nothing_elsewhere():
    rendering, faint = (ReferenceRasterizer()(scene_at(2, a)[None], CAMERA[None][None]) for a in (0.9, 0.2))
    depth, opaque = surface_depth(rendering), rendering.alpha > 0.5
    assert 0 < opaque.sum() < opaque.numel()
    torch.testing.assert_close(depth, torch.where(opaque, 2.0, 0.0))
    assert faint.alpha.max() > 0.2
    assert (surface_depth(faint) == 0).all()


def test_maps_share_one_scale_of_depth_and_agree_on_what_is_there(tmp_path):
    files, (near, far) = write_maps(tmp_path, [scene_at(1, 0.9), scene_at(4, 0.9)], CAMERA, ReferenceRasterizer())
    assert (round(near, 3), round(far, 3)) == (1, 4)
    assert sorted(files.values()) == sorted(path.name for path in tmp_path.iterdir())
    assert set(files) == {f"{kind}_{index:02}" for kind in ("depth", "normals", "opacity") for index in (0, 1)}
    for index in (0, 1):
        depth, normals, opacity = (read(tmp_path, f"{kind}_{index:02}") for kind in ("depth", "normals", "opacity"))
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
    write_scene_json(path, oblong, settings, 7, {"splat": "größe.ply"})
    with pytest.raises(ValueError, match="JSON"):
        write_scene_json(path, oblong, {"weight": torch.inf}, 0, {})
    scene = strict_json(path)
    stored = scene["reference_camera"]
    assert torch.equal(torch.tensor(stored["world_to_camera"]), oblong.world_to_camera)
    assert torch.equal(torch.tensor(stored["intrinsics"]), oblong.intrinsics)
    assert stored["image_size"] == [64, 48]
    assert (scene["settings"], scene["seed"], scene["files"]) == (settings, 7, {"splat": "größe.ply"})
    assert {"axes", "units", "quaternions", "colors"} <= set(scene["conventions"])
    assert list(tmp_path.iterdir()) == [path]
