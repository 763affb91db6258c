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


def camera() -> Cameras:
    return Cameras(torch.eye(4), pinhole(60, 16), (16, 16))


def scene_at(depth: float, opacity: float):
    """Two splats in one place, on the optical axis."""
    scene = some_gaussians(1, scale=0.1, opacity=opacity)[0]
    return dataclasses.replace(scene, means=torch.tensor([0.0, 0, depth]).expand(2, 3))


def read(folder, name: str) -> np.ndarray:
    return np.asarray(Image.open(folder / f"{name}.png"))


def test_depth_is_the_surfaces_where_it_is_opaque_and_nothing_elsewhere():
    rendering, faint = (ReferenceRasterizer()(scene_at(2, a)[None], camera()[None][None]) for a in (0.9, 0.2))
    depth, opaque = surface_depth(rendering), rendering.alpha > 0.5
    assert 0 < opaque.sum() < opaque.numel()
    torch.testing.assert_close(depth[opaque], torch.full_like(depth[opaque], 2))
    assert (depth[~opaque] == 0).all()
    assert faint.alpha.max() > 0.2
    assert (surface_depth(faint) == 0).all()


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


OBLONG = Cameras(torch.eye(4), pinhole(50.0, 64), (64, 48))


def test_the_camera_comes_back_exactly(tmp_path):
    write_scene_json(tmp_path / "s.json", OBLONG, {"steps": 50, "skip_weight": 0.5}, 7, {"splat": "größe.ply"})
    scene = strict_json(tmp_path / "s.json")
    stored = scene["reference_camera"]
    assert torch.equal(torch.tensor(stored["world_to_camera"]), OBLONG.world_to_camera)
    assert torch.equal(torch.tensor(stored["intrinsics"]), OBLONG.intrinsics)
    assert stored["image_size"] == [64, 48]
    assert scene["settings"] == {"steps": 50, "skip_weight": 0.5}
    assert scene["seed"] == 7
    assert scene["files"] == {"splat": "größe.ply"}
    assert {"axes", "units", "quaternions", "colors"} <= set(scene["conventions"])


def test_numbers_that_are_not_finite_leave_the_old_file(tmp_path):
    (tmp_path / "s.json").write_text("{}")
    with pytest.raises(ValueError, match="JSON"):
        write_scene_json(tmp_path / "s.json", OBLONG, {"weight": torch.inf}, 0, {})
    assert [path.read_text() for path in tmp_path.iterdir()] == ["{}"]


def test_the_title_is_drawn_above_all_pictures(tmp_path, rows):
    for name in ("a title", ""):
        contact_sheet(tmp_path / f"{name}.png", name, torch.ones(3, 36, 48), rows[:1], [0.0] * 8)
    first, second = (read(tmp_path, name).astype(int) for name in ("a title", ""))
    changed = np.argwhere(np.abs(first - second).sum(-1) > 0)
    assert len(changed) > 0
    assert changed[:, 0].max() < 40
