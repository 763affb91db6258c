from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from plyfile import PlyData

from completesplat.data.co3d import source
from completesplat.data.co3d.annotations import CO3DFrame, DepthMap
from completesplat.data.co3d.category import Filters, read_category
from completesplat.data.co3d.source import object_placement
from completesplat.data.loading.scenes import LoadedScenes, collate
from completesplat.data.placement import OBJECT_HALF_SIZE
from completesplat.data.splits import SeededSplit
from completesplat.data.toy.data_sets import SUBSET
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.errors import BadImage
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.photo.crop import Square
from completesplat.scene import SceneBatch


@pytest.fixture(scope="module")
def data(toy_root) -> ToyObjectsDataModule:
    module = ToyObjectsDataModule(str(toy_root), image_size=32)
    module.setup("test")
    return module


def scene_of(data: ToyObjectsDataModule) -> SceneBatch:
    """The only test scene."""
    (batch,) = data.test_dataloader()
    return batch[0]


def test_the_cloud_lies_on_what_is_seen_or_behind_it(data, toy_root):
    (name,) = data.store("test").names
    sequence, depths = data.source("test").read(name), scene_of(data).all_views().depths
    assert depths.shape == (4, 1, 32, 32)
    file = toy_root / "toy_objects" / name / "pointcloud.ply"
    vertices = PlyData.read(str(file))["vertex"]
    points = torch.stack([torch.from_numpy(vertices[axis].copy()).double() for axis in "xyz"], dim=-1)
    category = read_category(toy_root, "toy_objects", SUBSET, SeededSplit(0.1, 0.1, 0), Filters())
    frames = category.splits["test"].frames[name]
    points = points * OBJECT_HALF_SIZE / object_placement(file, frames, frames).half_size
    for view in range(4):
        pixels, z = project(sequence.cameras[view], points)
        columns, rows = pixels.long().clamp(0, 31).unbind(-1)
        seen = depths[view, 0][rows, columns]
        # At silhouettes the surface may be in a neighbouring pixel's centre only.
        nearest = -torch.nn.functional.max_pool2d(-depths[view], 3, stride=1, padding=1)[0][rows, columns]
        assert (z > 0.97 * nearest).all()
        assert ((z - seen).abs() < 0.03 * seen).double().mean() > 0.2


def test_only_the_test_reads_depths_and_what_has_none_costs_no_scene(data, monkeypatch):
    for loader in (data.train_dataloader(), data.val_dataloader()):
        assert next(iter(loader)).all_views().depths is None
    source, error = data.source("test"), BadImage("no finite depth in it", "depth.png")
    sequence = source.read(data.store("test").names[0])
    for reader, refused in ((None, []), (Mock(side_effect=error), ["depth.png"])):
        monkeypatch.setattr(type(source), "read", lambda *_, reader=reader: replace(sequence, read_depth=reader))
        loader = data.test_dataloader()
        (batch,) = loader
        assert batch.all_views().depths is None
        assert (loader.refused, [error.file for error in loader.refused_depths]) == ([], refused)


def test_depths_are_unknown_where_only_other_scenes_of_a_batch_have_them(data):
    known = scene_of(data)
    parts = {name: replace(getattr(known, name), depths=None) for name in ("reference", "targets")}
    unknown = replace(known, **parts)
    depths = collate([LoadedScenes(unknown, ()), LoadedScenes(known, ())]).scenes.all_views().depths
    assert torch.equal(depths[1], known.all_views().depths)
    assert depths[1].any()
    assert not depths[0].any()


@pytest.mark.parametrize("shape", [(8, 12), (4, 6), (16, 24)])
def test_maps_of_any_size_are_cut_as_the_image_is(monkeypatch, shape):
    """An image of 8 x 12; the square of 4 x 4 at (left 6, top 2), in 2 x 2 pixels, has centres at columns 7 and 9."""
    columns = (torch.arange(shape[1]) + 0.5) * 12 / shape[1]
    depth = columns.expand(1, *shape)
    monkeypatch.setattr(source, "read_depth", lambda *_: depth)
    camera = Cameras(torch.eye(4), pinhole(50.0, 8), (8, 12))
    frame = CO3DFrame(1, Path("image"), Path("mask"), DepthMap(Path("depth"), 1.0), camera)
    depths = source.square_depth(frame, Square(6, 2, 4), 2, factor=10.0)
    half_pixel = 12 / shape[1] / 2
    assert depths.shape == (1, 2, 2)
    assert depths[0].flatten().tolist() == pytest.approx([70, 90, 70, 90], abs=10 * half_pixel)
    unknown = source.square_depth(frame._replace(depth=None), Square(6, 2, 4), 2, factor=10.0)
    assert not unknown.any()
