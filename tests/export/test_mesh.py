"""Meshes, read by trimesh: closed, at the surface, with the right colours on the right sides."""

import math

import numpy as np
import pytest
import torch
import trimesh
from support import round_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.export import mesh
from completesplat.export.formats import write_format
from completesplat.export.splat_transform import PageView
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.tiled import TiledRasterizer

UP = torch.tensor([0.0, -1.0, 0.0])
PIVOT = torch.tensor([0.0, 0.0, 2.5])
VIEW = PageView(Cameras(torch.eye(4), pinhole(50, 64), (64, 64)), PIVOT, UP, 0.25)
VOXELS = 48
TO_GLTF = np.array([1, -1, -1])  # +y up, towards the viewer +z


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    for name, value in {"VOXELS": VOXELS, "VIEWS": 20, "SIDE": 96}.items():
        monkeypatch.setattr(mesh, name, value)


def blobs(points: np.ndarray, colors: object, size: float = 0.02) -> Gaussians:
    return round_gaussians(torch.tensor(points, dtype=torch.float32), size, 0.95, colors)


def sphere(center: tuple[float, ...], radius: float, count: int) -> np.ndarray:
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - height**2)
    return np.array(center) + radius * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=-1)


def written(folder, scene: Gaussians) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The mesh, and its colours in linear light."""
    file = write_format(folder, "a", "mesh", scene, VIEW, ["seed 7"], TiledRasterizer())
    assert file == {"a_mesh": "a_mesh.glb"}
    (result,) = trimesh.load(folder / "a_mesh.glb", process=False).geometry.values()
    colors = result.visual.vertex_attributes["color"]
    assert (colors.dtype, set(colors[:, 3])) == (np.float32, {1.0})
    shown = trimesh.load(folder / "a_mesh.glb", process=False, force="mesh", skip_materials=True).visual.vertex_colors
    assert np.abs(shown[:, :3] / 255 - colors[:, :3]).max() <= 1 / 255
    return result, colors[:, :3]


def test_a_hollow_sphere_becomes_a_closed_solid_and_what_floats_or_lies_behind_is_left_out(tmp_path):
    center = (0.1, -0.05, 2.9)
    radius = 0.35
    color = (0.5, 0.2, 0.8)
    wall = np.stack([*np.meshgrid(np.linspace(-2, 2, 30), np.linspace(-2, 2, 30)), np.full((30, 30), 5.0)], -1)
    scene = blobs(sphere(center, radius, 2500), color)
    others = [blobs(sphere((-0.5, 0.4, 2.6), 0.05, 100), color), blobs(wall.reshape(-1, 3), color, 0.1)]
    result, colors = written(tmp_path, merge_gaussians([scene, *others]))
    assert result.is_watertight
    assert result.is_winding_consistent
    assert result.body_count == 1
    distances = np.linalg.norm(result.vertices - np.array(center) * TO_GLTF, axis=1)
    voxel = (2 * radius + 0.35) / VOXELS  # the box holds the small sphere, too
    assert -0.5 * voxel < (distances - radius).min()
    assert (distances - radius).max() < 0.02 + 1.5 * voxel  # 0.02: the Gaussians' standard deviation
    assert result.volume > 0.95 * 4 / 3 * math.pi * radius**3  # a shell has far less
    linear = [((value + 0.055) / 1.055) ** 2.4 for value in color]
    np.testing.assert_allclose(colors, np.tile(linear, (len(colors), 1)), atol=0.01)


def test_each_side_of_a_cube_has_its_colour_on_the_right_side(tmp_path):
    along = np.linspace(-0.35, 0.35, 24)
    first, second = (axis.ravel() for axis in np.meshgrid(along, along))
    parts = []
    sides = {}
    for axis in range(3):
        for sign in (-1, 1):
            points = np.insert(np.stack([first, second], -1), axis, 0.35 * sign, axis=1)
            color = np.array([axis == 0, axis == 1, axis == 2], float) if sign > 0 else np.eye(3)[axis] * -1 + 1
            parts.append(blobs(points + np.array([0, 0, 2.9]), color))
            sides[axis, sign] = color
    result, colors = written(tmp_path, merge_gaussians(parts))
    assert result.is_watertight
    middle = np.array([0, 0, -2.9])
    for (axis, sign), color in sides.items():
        outward = np.eye(3)[axis] * sign * TO_GLTF
        places = (result.vertices - middle) @ outward
        mask = (places > 0.33) & (abs(result.vertices - middle).max(1) - places < 1e-6)
        inner = mask & (np.sort(abs(result.vertices - middle), axis=1)[:, 1] < 0.25)
        assert inner.sum() > 50
        np.testing.assert_allclose(colors[inner], np.tile(color, (inner.sum(), 1)), atol=0.05)
        assert ((result.vertex_normals[inner] @ outward) > 0.5).all()


def test_what_no_view_sees_is_inside_and_what_lies_before_surfaces_or_emptiness_outside():
    cameras = mesh.cameras_around(torch.zeros(3), 1.0, 0.5)  # at a distance of sqrt(5)
    center = torch.zeros(1, 3)
    ahead = 5**0.5
    depths = torch.ones(20, 1, 96, 96)
    for depth, expected in ((ahead - 0.21, -1.0), (ahead - 0.1, -0.5), (ahead, 0), (ahead + 0.1, 0.5), (9, 1), (0, 1)):
        result = mesh.signed_distances(center, cameras, depths * depth, 0.2)
        torch.testing.assert_close(result, torch.tensor([float(expected)]), rtol=0, atol=1e-4)


def test_every_field_gives_a_closed_surface():
    field = np.random.default_rng(0).standard_normal((12, 12, 12)).astype(np.float32)
    corners, faces, _ = mesh.surface_of(field)
    result = trimesh.Trimesh(corners.numpy(), faces, process=False)
    assert result.is_watertight
    assert result.volume > 0


def test_where_there_is_nothing_there_is_no_mesh(tmp_path):
    behind = blobs(sphere((0, 0, -3), 0.3, 50), (1.0, 0, 0))
    with pytest.raises(CompleteSplatError, match="no surface in the middle"):
        write_format(tmp_path, "a", "mesh", behind, VIEW, rasterizer=TiledRasterizer())
    speck = blobs(sphere((0, 0, 3), 1e-9, 1), (1.0, 0, 0))
    with pytest.raises(CompleteSplatError, match="too thin to be a solid"):
        write_format(tmp_path, "a", "mesh", speck, VIEW, rasterizer=TiledRasterizer())
    with pytest.raises(CompleteSplatError, match="a rasterizer is needed for mesh"):
        write_format(tmp_path, "a", "mesh", behind, VIEW)
    assert not list(tmp_path.iterdir())
