"""Meshes of strangers: files outside of the folder, pipes, stray faces. `test_cases.py` has damaged textures."""

import os
from pathlib import Path

import meshes
import numpy as np
import pytest
from PIL import Image
from support import strict_json

from completesplat.data.rendered.random_scenes import textures_of
from completesplat.data.rendered.rendering import render
from completesplat.errors import DataError
from completesplat.ply_files import read_vertices

QUICK = meshes.SETTINGS | {"views": 2, "size": 16, "samples": 1, "workers": 1}


@pytest.fixture(scope="module")
def blender() -> None:
    meshes.need_blender()


def png(path: Path) -> bytes:
    Image.new("RGB", (8, 8), (200, 40, 40)).save(path)
    return path.read_bytes()


@pytest.mark.parametrize(
    ("folder", "texture"),
    [("meshes/1", "../t.png"), ("meshes", f". .. {'x' * 5000}")],
    ids=["file above the mesh", "folders and a long word"],
)
def test_files_anywhere_in_the_folder_of_meshes_are_taken_and_folders_and_long_words_are_none(
    tmp_path, folder, texture
):
    (tmp_path / "meshes/1").mkdir(parents=True)
    png(tmp_path / "meshes/t.png")
    meshes.write_textured(tmp_path / folder, texture)
    with pytest.raises(DataError, match=r"Blender failed: has started$"):
        render(str(tmp_path / "meshes"), out=tmp_path / "data", blender=meshes.write_stand_in(tmp_path), **QUICK)


def test_a_pipe_among_the_textures_of_floors_is_left_out(tmp_path):
    png(tmp_path / "a.png")
    os.mkfifo(tmp_path / "b.png")
    assert textures_of(tmp_path) == [str(tmp_path / "a.png")]


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_a_speck_far_from_the_mesh_is_left_out_and_a_vertex_without_faces_has_no_effect(tmp_path, caplog):
    cube = meshes.write_cube(tmp_path / "meshes/cube.obj", half=1)
    render(str(tmp_path / "meshes"), out=tmp_path / "alone", **QUICK)
    speck = "v 25 0 0\nv 25.001 0 0\nv 25 0.001 0\nf 9/1 10/2 11/3\nv 0 900 0\n"
    cube.write_text(cube.read_text() + speck)
    render(str(tmp_path / "meshes"), out=tmp_path / "both", **QUICK)
    assert "cube: 1 stray faces are left out, far from 99 % of its surface" in caplog.text
    alone, both = (strict_json(tmp_path / name / "rendered/cube/object.json") for name in ("alone", "both"))
    assert (alone["left_out"], both["left_out"]) == (0, 1)
    assert both["scale"] == pytest.approx(1 / np.sqrt(3))
    clouds = [read_vertices(tmp_path / name / "rendered/cube/pointcloud.ply", "xyz") for name in ("alone", "both")]
    assert (clouds[0] == clouds[1]).all()


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_a_thin_part_that_reaches_far_stays(tmp_path):
    """A pole of 0.4 % of the surface that is twice as high as the cube."""
    cube = meshes.write_cube(tmp_path / "meshes/cube.obj", half=1)
    pole = "v 0 1 0\nv 0.02 1 0\nv 0.02 4 0\nv 0 4 0\nf 9/1 10/2 11/3 12/4\n"
    cube.write_text(cube.read_text() + pole)
    render(str(tmp_path / "meshes"), out=tmp_path / "data", **QUICK)
    record = strict_json(tmp_path / "data/rendered/cube/object.json")
    assert record["left_out"] == 0
    assert record["center"] == pytest.approx([0, 0, 1.5], abs=1e-6)
