"""Images of meshes without Blender, against closed forms: depth, coverage, light, shadows, textures."""

import math
from threading import Event

import meshes
import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.data.rendered.mesh_reading import packed_textures, read_mesh, to_linear, to_srgb
from completesplat.data.rendered.mesh_renderer import ambient_light, draw_job
from completesplat.data.rendered.random_scenes import view_of
from completesplat.data.rendered.shading import SHEEN, filtered
from completesplat.geometry.cameras import Cameras, look_at, pinhole

trimesh = pytest.importorskip("trimesh")

SIZE = 64
HALF = 1 / math.sqrt(3)
"""Half edge of the cube after scaling: its corners are at distance 1."""
UNIFORM = {"sky": [[0.4] * 3] * 2, "strength": 0.0, "color": [1.0] * 3, "angle": 0.01, "elevation": 1.0, "azimuth": 0.0}


def camera(eye, size=SIZE, degrees=40.0):
    matrix = look_at(
        torch.tensor(eye, dtype=torch.float64), torch.zeros(3).double(), torch.tensor([0.0, 0, 1]).double()
    )
    return Cameras(matrix, pinhole(degrees, size).double(), (size, size))


def drawn(mesh, folder, cameras, **changes):
    """Draw a mesh; return its images (sRGB, 0 to 1), and its depth, mask and coverage."""
    folder.mkdir(exist_ok=True)
    job = {"mesh": str(mesh), "root": str(mesh.parent.resolve()), "folder": str(folder), "samples": 16, "up": None}
    job |= {"views": [view_of(one) for one in cameras], "room": 3.0, "floor": None, "wall": None}
    job |= {"light": UNIFORM, "hidden": None, **changes}
    record = draw_job(job, Event())
    images = [np.asarray(Image.open(folder / f"{k:04d}.png")) / 255 for k in range(len(cameras))]
    geometry = [np.load(folder / f"{k:04d}.npy") for k in range(len(cameras))]
    return images, geometry, record


@pytest.fixture
def cube(tmp_path):
    return meshes.write_cube(tmp_path / "meshes/cube.obj", half=3, center=(50, 20, -10))


def rays_of(one):
    y, x = np.mgrid[: one.image_size[0], : one.image_size[1]] + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    matrix = one.world_to_camera.numpy()
    directions = pixels @ np.linalg.inv(one.intrinsics.numpy()).T @ matrix[:3, :3]
    return -matrix[:3, :3].T @ matrix[:3, 3], directions


def test_depth_and_mask_of_a_cube_are_where_rays_enter_its_slabs(cube, tmp_path):
    cameras = [camera((1.9, -1.6, 1.7)), camera((-2.2, 0.4, -0.9)), camera((0.3, 2.6, 0.2))]
    _, geometry, record = drawn(cube, tmp_path / "out", cameras)
    for one, (depth, seen, coverage) in zip(cameras, (np.moveaxis(x, -1, 0) for x in geometry), strict=True):
        eye, rays = rays_of(one)

        low, high = (np.array([side * HALF - eye]) / rays for side in (-1, 1))
        enter = np.minimum(low, high).max(-1)
        leave = np.maximum(low, high).min(-1)
        hit = enter <= leave

        assert ((seen == 1) == hit).mean() > 0.999
        both = (seen == 1) & hit
        assert np.abs(depth[both] - enter[both]).max() < 1e-4
        assert coverage.mean() == pytest.approx(hit.mean(), abs=0.01)
    assert record["center"] == pytest.approx([50, 10, 20])  # y points up in the file
    assert record["scale"] == pytest.approx(HALF / 3)


def test_a_white_surface_under_a_uniform_sky_has_the_skys_own_radiance():
    sky = np.full((2, 3), 0.7)
    assert ambient_light(sky, None) == pytest.approx(np.full((33, 3), 0.7), rel=2e-3)
    half = ambient_light(sky, np.zeros(3))
    # Of a wall, whose normal is level, half of the sky is above the horizon.
    assert half[16] == pytest.approx(np.full(3, 0.35), rel=2e-3)
    assert half[-1] == pytest.approx(np.full(3, 0.7), rel=2e-3)
    assert half[0] == pytest.approx(np.zeros(3), abs=1e-6)
    # A room whose walls and ground are as bright as the sky is no different; black walls hide most of it.
    assert ambient_light(sky, sky[0], sky[0]) == pytest.approx(np.full((33, 3), 0.7), rel=2e-3)
    room = ambient_light(sky, np.zeros(3), np.zeros(3))
    assert room[-1] == pytest.approx(np.full(3, 0.7 * (1 - 0.87**2)), rel=0.05)


def test_a_plain_mesh_under_a_uniform_sky_has_one_colour(tmp_path):
    ball = trimesh.creation.icosphere(3)
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=np.tile([200, 100, 50, 255], (len(ball.vertices), 1)))
    ball.export(tmp_path / "ball.ply")
    images, geometry, _ = drawn(tmp_path / "ball.ply", tmp_path / "out", [camera((3.0, 0, 0))])
    inside = geometry[0][..., 2] == 1
    expected = to_srgb(0.4 * (SHEEN + (1 - SHEEN) * to_linear(np.array([200, 100, 50]) / 255)))
    assert np.abs(images[0][inside] - expected).max() < 0.01


def test_the_sun_lights_by_the_cosine_and_the_ground_behind_the_object_lies_in_shadow(tmp_path):
    """A cube floats one unit above the ground, and the sun stands in the zenith."""
    cube = trimesh.creation.box((1.0, 1.0, 1.0)).apply_translation((0, 0, 1.5))
    base = trimesh.creation.box((0.02, 0.02, 0.02))
    trimesh.util.concatenate([cube, base]).export(tmp_path / "cube.ply")
    light = UNIFORM | {"strength": 0.5 * math.pi, "elevation": math.pi / 2, "sky": [[0.1] * 3] * 2}
    white = {"pattern": "checker", "colors": [[1.0] * 3] * 2, "repeats": 1.0, "file": ""}
    images, geometry, record = drawn(
        tmp_path / "cube.ply", tmp_path / "out", [camera((0.1, -5.0, 2.5), 128, 45)], light=light, floor=white
    )
    linear = to_linear(images[0]).mean(-1)
    depth = geometry[0][..., 0]
    eye, rays = rays_of(camera((0.1, -5.0, 2.5), 128, 45))
    places = eye + depth[..., None] * rays
    scale = record["scale"]
    ground = np.abs(places[..., 2] - places[..., 2][geometry[0][..., 0] < 100].min()) < 1e-3
    apart = np.abs(places[..., :2]).max(-1)
    lit = linear[ground & (apart > 1.2 * scale) & (apart < 3)]
    assert np.quantile(np.abs(lit - 0.6), 0.99) < 0.01
    under = ground & (apart < 0.4 * scale) & (apart > 0.05 * scale)
    assert under.sum() > 10
    assert np.abs(linear[under] - 0.1).max() < 0.02


def test_far_textures_show_their_mean_in_linear_light():
    """Of black and white pixels this is 188 of 255 in sRGB, not 128."""
    checker = np.indices((64, 64)).sum(0) % 2 * 255
    image = np.stack([checker, checker, checker, np.full_like(checker, 255)], axis=-1).astype(np.uint8)
    textures = packed_textures([image])
    assert textures.levels.shape == (1, 4, 3)
    color = np.array(filtered(textures.texels, textures.levels, 0, 0.3, 0.6, 0.1))
    assert to_srgb(color) * 255 == pytest.approx(np.full(3, 188), abs=1)
    columns = np.array([0.5, 1.5, -0.5]) / 64
    near = [filtered(textures.texels, textures.levels, 0, u, 1 - 0.5 / 64, 0.0)[0] for u in columns]
    assert near == pytest.approx([0, 1, 1], abs=1e-4)  # the texture repeats


def square(path, pixels, **material):
    """Write a GLB of a square in the plane of x and y (its format's y points up), with a texture."""
    path.parent.mkdir(exist_ok=True)
    image = Image.fromarray(np.asarray(pixels, np.uint8))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    kind = trimesh.visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.0, **material)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=kind)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False).export(path)
    return path


def test_textures_are_upright_and_not_mirrored(tmp_path):
    red, green, blue, white = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
    rows = [[red] * 8 + [green] * 8] * 8 + [[blue] * 8 + [white] * 8] * 8
    path = square(tmp_path / "meshes/square.glb", rows)
    images, geometry, _ = drawn(
        path, tmp_path / "out", [camera((0.0, -4.0, 0.0))]
    )  # the format's z points to the camera
    image = images[0]
    assert geometry[0][..., 1].mean() > 0.2
    middle = SIZE // 2
    colors = [image[middle + y, middle + x] for y in (-8, 8) for x in (-8, 8)]
    assert [color.argmax() for color in colors[:3]] == [0, 1, 2]
    assert colors[3].min() > 0.5


def test_transparent_parts_of_a_texture_are_holes(tmp_path):
    pixels = np.full((32, 32, 4), 255, np.uint8)
    pixels[:, 16:, 3] = 0
    path = square(tmp_path / "meshes/half.glb", pixels, alphaMode="MASK")
    _, geometry, _ = drawn(path, tmp_path / "out", [camera((0.0, -4.0, 0.0))])
    seen = geometry[0][..., 1]
    assert seen[:, SIZE // 2 + 2 :].sum() == 0
    assert seen[:, : SIZE // 2 - 2].sum() > 100


def test_paint_changes_only_what_the_first_camera_does_not_see(cube, tmp_path):
    first = camera((2.5, 0.3, 0.4))
    toward = (first.centers / first.centers.norm()).tolist()
    hidden = {
        "toward": toward,
        "least": 1 / first.centers.norm().item(),
        "colors": [[0.5, 0.03, 0.03], [0.03, 0.08, 0.5]],
    }
    cameras = [first, camera((-2.5, 0.3, 0.4))]
    drawn(cube, tmp_path / "painted", cameras, hidden=hidden)
    plain, _, _ = drawn(cube, tmp_path / "plain", cameras)
    read = lambda name: np.asarray(Image.open(tmp_path / "painted" / name)) / 255  # noqa: E731
    assert (read("0000.png") == plain[0]).all()
    assert (read("1_0000.png") == plain[0]).all()
    middle = SIZE // 2
    assert read("0001.png")[middle, middle].argmax() == 0
    assert read("1_0001.png")[middle, middle].argmax() == 2


def test_a_sharp_edge_is_shaded_flat_and_a_ball_smoothly(tmp_path):
    for name, solid in (("box", trimesh.creation.box()), ("gem", trimesh.creation.icosahedron())):
        solid.export(tmp_path / f"{name}.ply")  # each vertex belongs to three or five faces
        mesh = read_mesh(tmp_path / f"{name}.ply", tmp_path)
        crosses = np.cross(mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0])
        flat = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
        assert mesh.normals == pytest.approx(np.repeat(flat[:, None], 3, axis=1))
    trimesh.creation.icosphere(4).export(tmp_path / "ball.ply")
    ball = read_mesh(tmp_path / "ball.ply", tmp_path)
    assert ball.normals == pytest.approx(ball.corners, abs=0.01)
