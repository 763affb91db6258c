"""Reading of textured meshes: where textures are looked for, and what is refused."""

import shutil
from pathlib import Path

import meshes
import numpy as np
import pytest
from PIL import Image

from completesplat.data.rendered.assets import BrokenMesh
from completesplat.data.rendered.mesh_reading import read_mesh

CASES = Path(__file__).parents[2] / "cases"
trimesh = pytest.importorskip("trimesh")


@pytest.fixture
def cube(tmp_path):
    """OBJ of a cube in its own folder, with its material and its texture beside it."""
    return meshes.write_cube(tmp_path / "root/cube/meshes/model.obj")


def texture_of(path, root):
    """Return the mean linear colour of the first texture, on which none of the cube's colours would be 1."""
    mesh = read_mesh(path, root.resolve())
    start, width, height = mesh.textures.levels[0, 0]
    return mesh.textures.texels[start : start + 4 * width * height].reshape(-1, 4)[:, :3].mean() / 65535


def moved(cube: Path, place: str) -> Path:
    """Move the texture and return its new path."""
    path = (cube.parent / place).resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(cube.with_suffix(".png"), path)
    return path


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("model.png", "model.png"),
        ("tex/model.png", "tex\\model.png"),
        ("model.png", "C:\\work\\MODEL.PNG"),
        ("../materials/textures/model.png", "model.png"),
        ("MODEL.png", "model.PNG"),
    ],
    ids=["beside the mesh", "backslashes", "path of another machine", "Google Scanned Objects", "another case"],
)
def test_textures_are_found(cube, tmp_path, place, name):
    there = texture_of(cube, tmp_path / "root")
    cube.with_suffix(".mtl").write_text(f"newmtl checker\nmap_Kd {name}\n")
    if place != "model.png":
        moved(cube, place)
    assert texture_of(cube, tmp_path / "root") == there
    assert 0 < there < 1


@pytest.mark.parametrize(("up", "tall"), [(None, 1), ("y", 1), ("z", 2)])
def test_a_scan_stands_if_it_is_said_that_z_points_up(tmp_path, up, tall):
    """The box is twice as high as wide; it lies on its back where y is taken to point up."""
    mesh = read_mesh(meshes.write_scan(tmp_path / "scan"), tmp_path.resolve(), up)
    sides = np.ptp(mesh.corners, axis=(0, 1))
    assert sides.argmax() == tall
    assert sides.max() == pytest.approx(2 * sides.min())
    assert texture_of(tmp_path / "scan/meshes/model.obj", tmp_path) < 0.9


def test_what_gltf_says_goes_before_a_given_axis_and_ply_has_none(tmp_path):
    box = trimesh.creation.box((1, 1, 2))
    tall = {}
    for name in ("box.glb", "box.ply"):
        box.export(tmp_path / name)
        for up in (None, "y", "z"):
            corners = read_mesh(tmp_path / name, tmp_path, up).corners
            tall[name, up] = int(np.ptp(corners, axis=(0, 1)).argmax())
    assert {tall["box.glb", up] for up in (None, "y", "z")} == {1}
    assert [tall["box.ply", up] for up in (None, "y", "z")] == [2, 1, 2]


def test_a_texture_that_is_missing_outside_or_damaged_is_refused(cube, tmp_path):
    path = moved(cube, "../../../outside.png")
    with pytest.raises(BrokenMesh, match=r"its texture model.png is missing"):
        read_mesh(cube, tmp_path / "root")
    cube.with_suffix(".mtl").write_text("newmtl checker\nmap_Kd ../../../outside.png\n")
    with pytest.raises(BrokenMesh, match=r"its texture outside.png lies outside of the folder of meshes"):
        read_mesh(cube, (tmp_path / "root").resolve())
    content = path.read_bytes()
    (cube.parent / "outside.png").write_bytes(content[: len(content) // 2])
    cube.with_suffix(".mtl").write_text("newmtl checker\nmap_Kd outside.png\n")
    with pytest.raises(BrokenMesh, match=r"its texture outside.png cannot be read"):
        read_mesh(cube, (tmp_path / "root").resolve())


@pytest.mark.parametrize("name", ["badtex.glb", "cuttex.glb", "lfstex.glb", "ktx2only.glb"])
def test_textures_of_glb_files_that_cannot_be_read_are_refused(name):
    with pytest.raises(BrokenMesh, match=r"texture"):
        read_mesh(CASES / "meshes" / name, CASES.resolve())


def test_faces_that_are_stray_empty_or_not_finite(cube, tmp_path):
    text = cube.read_text()
    cube.write_text(text + "v 99 0 0\nv 99.001 0 0\nv 99 0.001 0\nf 9/1 10/2 11/3\n")
    mesh = read_mesh(cube, tmp_path.resolve())
    assert mesh.left_out == 1
    assert np.linalg.norm(mesh.corners, axis=-1).max() == pytest.approx(1)
    for content, reason in (("v 0 0 0\n", "no faces"), ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite")):
        cube.write_text(content)
        with pytest.raises(BrokenMesh, match=reason):
            read_mesh(cube, tmp_path.resolve())
    cube.write_text("v 1 1 1\n" * 3 + "f 1 2 3\n")
    with pytest.raises(BrokenMesh, match="in one place"):
        read_mesh(cube, tmp_path.resolve())


def test_colours_of_vertices_and_materials_are_linear(tmp_path):
    triangle = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    triangle.visual = trimesh.visual.ColorVisuals(triangle, vertex_colors=[[188, 188, 188, 255]] * 3)
    triangle.export(tmp_path / "t.ply")
    assert read_mesh(tmp_path / "t.ply", tmp_path).colors == pytest.approx(np.full((1, 3, 3), 0.503), abs=2e-3)
    (tmp_path / "t.mtl").write_text("newmtl m\nKd 0.735 0.735 0.735\n")
    (tmp_path / "t.obj").write_text("mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    assert read_mesh(tmp_path / "t.obj", tmp_path).colors == pytest.approx(np.full((1, 3, 3), 0.5), abs=5e-3)


@pytest.mark.parametrize(
    ("material", "name"),
    [
        ({}, ""),
        ({"pbr": {"metallicFactor": 1.0}}, "metal"),
        ({"pbr": {"metallicFactor": 1.0}, "extensions": {"KHR_materials_unlit": {}}}, ""),
        ({"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}}, "glass"),
        ({"alphaMode": "BLEND"}, "half-transparent materials"),
        ({"emissiveFactor": [0.0, 2.0, 0.0]}, "materials that glow"),
        ({"pbr": {"metallicFactor": 0.9}, "alphaMode": "BLEND"}, "metal and half-transparent materials"),
    ],
)
def test_what_only_blender_draws_is_named(tmp_path, material, name):
    assert read_mesh(meshes.write_ball(tmp_path / "ball.glb", **material), tmp_path).beyond == name


def test_a_material_that_says_nothing_is_of_metal_by_the_standard_unless_a_texture_says_where(tmp_path):
    triangle = meshes.write_gltf(tmp_path / "t.gltf", "t.png")
    Image.new("RGB", (8, 8), (200, 40, 40)).save(tmp_path / "t.png")
    assert read_mesh(triangle, tmp_path).beyond == "metal"
    surface = '"metallicRoughnessTexture": {"index": 0}, "baseColorTexture"'
    triangle.write_text(triangle.read_text().replace('"baseColorTexture"', surface))
    assert read_mesh(triangle, tmp_path).beyond == ""


PER_FACE = "", "property list uchar float texcoord\n", "", " 6 0 0 1 0 0 1"
PER_VERTEX = "property float s\nproperty float t\n", "", " .5 .5", ""


def write_textured_ply(folder: Path, stored: tuple[str, str, str, str], textures: int) -> Path:
    """Write a tetrahedron with red textures, whose coordinates are those of faces or of vertices."""
    vertex, face, of_vertex, of_face = stored
    names = "".join(f"comment TextureFile {number}.png\n" for number in range(textures))
    for number in range(textures):
        Image.new("RGB", (8, 8), (200, 30, 30)).save(folder / f"{number}.png")
    axes = "property float x\nproperty float y\nproperty float z\n"
    faces = f"element face 4\nproperty list uchar int vertex_indices\n{face}end_header\n"
    rows = [f"{corner}{of_vertex}\n" for corner in ("0 0 0", "1 0 0", "0 1 0", "0 0 1")]
    rows += [f"3 {corners}{of_face}\n" for corners in ("0 2 1", "0 1 3", "1 2 3", "0 3 2")]
    header = f"ply\nformat ascii 1.0\n{names}element vertex 4\n{axes}{vertex}{faces}"
    (folder / "a.ply").write_text(header + "".join(rows))
    return folder / "a.ply"


@pytest.mark.parametrize("stored", [PER_FACE, PER_VERTEX])
def test_a_ply_file_has_its_texture(tmp_path, stored):
    mesh = read_mesh(write_textured_ply(tmp_path, stored, 1), tmp_path.resolve())
    start = mesh.textures.levels[0, 0, 0]
    values = np.array([200, 30, 30]) / 255
    linear = ((values + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(mesh.textures.texels[start : start + 3] / 65535, linear, atol=1e-4)
    np.testing.assert_allclose(mesh.colors, 1)


def test_a_ply_file_with_several_textures_is_refused(tmp_path):
    with pytest.raises(BrokenMesh, match="several textures"):
        read_mesh(write_textured_ply(tmp_path, PER_FACE, 2), tmp_path.resolve())
