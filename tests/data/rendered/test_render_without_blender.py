"""`data render` where there is no Blender: from meshes to scenes that a data module reads."""

import logging

import meshes
import numpy as np
import pytest
from PIL import Image
from support import refused, strict_json

from completesplat.data.rendered.blender import VARIABLE
from completesplat.data.rendered.rendering import RenderedDataModule, render
from completesplat.errors import CompleteSplatError, DataError, MissingFile

trimesh = pytest.importorskip("trimesh")
QUICK = meshes.SETTINGS | {"renderer": "mesh", "views": 4, "size": 32, "samples": 4}


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """Leave no Blender to be found."""
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("completesplat.data.rendered.blender.find_spec", lambda name: None)


@pytest.fixture
def folder(tmp_path):
    meshes.write_cube(tmp_path / "meshes/cube.obj")
    ball = trimesh.creation.icosphere(2)
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=np.tile([40, 160, 60, 255], (len(ball.vertices), 1)))
    ball.export(tmp_path / "meshes/ball.glb")
    return tmp_path / "meshes"


def test_a_data_module_reads_what_was_drawn_with_points_on_the_object_and_masks_around_it(folder, tmp_path):
    render(str(folder), out=tmp_path / "data", **QUICK)
    data = RenderedDataModule(root=str(tmp_path / "data"), image_size=32, test_fraction=1, val_fraction=0.0)
    data.setup("test")
    batches = list(data.test_dataloader())
    assert sorted(name for batch in batches for name in batch.names) == ["ball", "cube"]
    for batch in batches:
        views = batch.all_views()
        assert 0.05 < views.masks.mean() < 0.8
        assert views.depths is not None
        assert (views.depths[views.masks == 1] > 0).all()
    record = strict_json(tmp_path / "data/rendered/cube/object.json")
    assert len(record["frames"]) == 4
    assert record["scale"] == pytest.approx(1 / np.linalg.norm([3, 3, 3]))


def test_the_same_seed_gives_the_same_files_and_a_second_call_draws_nothing(folder, tmp_path):
    for name in ("first", "second"):
        render(str(folder), out=tmp_path / name, **QUICK)
    files = [sorted(path for path in (tmp_path / name).rglob("*.jpg")) for name in ("first", "second")]
    assert len(files[0]) == 8
    assert [path.read_bytes() for path in files[0]] == [path.read_bytes() for path in files[1]]
    times = [path.stat().st_mtime_ns for path in files[0]]
    render(str(folder), out=tmp_path / "first", **QUICK)
    assert [path.stat().st_mtime_ns for path in files[0]] == times


def test_a_format_that_needs_blender_and_a_light_file_are_refused_in_one_line_without_it(folder, tmp_path):
    trimesh.creation.box().export(folder / "box.stl")
    with pytest.raises(CompleteSplatError, match="no Blender"):
        render(str(folder), out=tmp_path / "data", **QUICK)
    (folder / "box.stl").unlink()
    (tmp_path / "sky.hdr").write_bytes(b"")
    with pytest.raises((CompleteSplatError, DataError)):
        render(str(folder), out=tmp_path / "data", **QUICK | {"light": str(tmp_path / "sky.hdr")})


def test_a_material_that_only_blender_draws_is_named(tmp_path, caplog):
    (tmp_path / "meshes").mkdir()
    meshes.write_ball(tmp_path / "meshes/ball.glb", pbr={"metallicFactor": 1.0})
    with caplog.at_level(logging.WARNING):
        render(str(tmp_path / "meshes"), out=tmp_path / "data", **QUICK)
    assert "ball: metal: drawn as plain colours; renderer=blender draws them" in caplog.text


def test_the_command_draws_a_folder_and_refuses_one_without_meshes(command, folder, tmp_path):
    settings = ["views=2", "size=16", "samples=1", "workers=1"]
    command.succeeds("data", "data_task=render", f"meshes={folder}", *settings, f"out={tmp_path / 'data'}")
    image = np.asarray(Image.open(next((tmp_path / "data/rendered/cube/images").iterdir())))
    assert image.std() > 10
    (tmp_path / "empty").mkdir()
    line = refused("data", "data_task=render", f"meshes={tmp_path / 'empty'}", *settings, f"out={tmp_path / 'more'}")
    assert "no meshes there" in line


def test_the_meshes_of_a_list_alone_are_drawn(folder, tmp_path):
    trimesh.creation.box().export(folder / "box.stl")  # would need Blender
    (tmp_path / "list.txt").write_text("ball\n")
    render(str(folder), out=tmp_path / "data", objects=str(tmp_path / "list.txt"), **QUICK)
    data = RenderedDataModule(root=str(tmp_path / "data"), image_size=32, test_fraction=1, val_fraction=0.0)
    assert data.source("test").names == ["ball"]
    (tmp_path / "list.txt").write_text("ball\ncone\n")
    with pytest.raises(MissingFile, match=r"1 of 2 meshes of objects=.*list\.txt: cone"):
        render(str(folder), out=tmp_path / "data", objects=str(tmp_path / "list.txt"), **QUICK)
