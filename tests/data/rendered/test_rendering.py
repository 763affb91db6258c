"""Renders of meshes by Blender: exact cameras, depth and masks, any reader, broken meshes, continuation."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import meshes
import numpy as np
import pytest
import torch
from packed_sequences import contents
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.feature import corner_peaks
from support import SMALL, strict_json, waited_for

from completesplat.data.co3d.annotations import read_frames
from completesplat.data.co3d.depth_maps import read_depth
from completesplat.data.rendered.random_scenes import PAINTS
from completesplat.data.rendered.rendering import RenderedDataModule, render
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras, look_at, pixel_rays, project

pytestmark = pytest.mark.blender
QUICK = meshes.SETTINGS | {"views": 3, "size": 32, "samples": 4, "workers": 1}
HALF = 1 / np.sqrt(3)
"""Half edge of the cube after scaling: its corners are at distance 1."""


@pytest.fixture(scope="module", autouse=True)
def blender() -> None:
    meshes.need_blender()


def off_center(width: int, height: int) -> list[Cameras]:
    """Cameras whose principal point is not the image's centre, of images that are not square."""
    eyes = torch.tensor([[1.9, -1.6, 1.7], [-1.6, 1.9, 1.5], [-1.8, -1.7, -1.6]], dtype=torch.float64)
    targets = torch.tensor([[0.1, 0, 0], [0, -0.1, 0.1], [0, 0, 0]], dtype=torch.float64)
    focal = 1.3 * height
    intrinsics = torch.tensor([[focal, 0, 0.44 * width], [0, focal, 0.57 * height], [0, 0, 1]], dtype=torch.float64)
    matrices = look_at(eyes, targets, torch.tensor([0.0, 0, 1]).double())
    return [Cameras(matrix, intrinsics, (height, width)) for matrix in matrices]


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of renders of a checker cube, 6 units wide and far from its file's origin, by `off_center` cameras."""
    root = tmp_path_factory.mktemp("cube")
    meshes.write_cube(root / "meshes/cube.obj", half=3, center=(50, 20, -10))
    path = meshes.write_transforms(root / "cameras.json", off_center(240, 180))
    settings = QUICK | {"size": 180, "samples": 16, "cameras": str(path), "floor": "none"}
    render(str(root / "meshes"), out=root / "data", **settings)
    return root / "data"


def frames_of(root: Path, name: str):
    frames = read_frames(root, root / "rendered/frame_annotations.jgz", lambda *key: True, pytest.fail)
    return [frames[name][number] for number in sorted(frames[name])]


def crossings(camera: Cameras) -> np.ndarray:
    """Pixels [n 2] of the inner corners of the checkers on the faces that the camera sees."""
    ticks = (2 * np.arange(1, meshes.SQUARES) / meshes.SQUARES - 1) * HALF
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    points = []
    for axis in range(3):
        for side in (-HALF, HALF):
            if side * camera.centers[axis] > HALF**2:
                points.append(np.insert(grid, axis, side, axis=1))
    return project(camera, torch.from_numpy(np.concatenate(points)))[0].numpy()


def saddles(path: Path) -> np.ndarray:
    """Crossings [n 2] of an image's checkers, found without its camera: saddle points of the smoothed image.

    Newton's method finds the gradient's zero from where the Hessian's determinant is lowest.
    """
    grey = np.asarray(Image.open(path).convert("L")).astype(float)
    orders = [(0, 1), (1, 0), (0, 2), (1, 1), (2, 0)]  # along rows and columns
    derivatives = [gaussian_filter(grey, 1.5, order=order) for order in orders]
    response = derivatives[3] ** 2 - derivatives[2] * derivatives[4]
    places = corner_peaks(response, min_distance=3, threshold_rel=0.05, exclude_border=4)[:, ::-1].astype(float)
    for _ in range(5):
        x, y, xx, xy, yy = (map_coordinates(values, places.T[::-1], mode="nearest") for values in derivatives)
        hessians = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        places = places - np.linalg.solve(hessians, np.stack([x, y], -1)[..., None])[..., 0].clip(-1, 1)
    return places + 0.5


def test_the_corners_of_a_checker_cube_are_where_the_cameras_project_them(cube):
    for frame, camera in zip(frames_of(cube, "cube"), off_center(240, 180), strict=True):
        assert torch.allclose(frame.camera.world_to_camera, camera.world_to_camera, atol=1e-9)
        assert torch.allclose(frame.camera.intrinsics, camera.intrinsics, atol=1e-6)
        expected, found = crossings(frame.camera), saddles(frame.image)
        errors = np.linalg.norm(expected[:, None] - found, axis=-1).min(axis=1)
        assert len(expected) == 27
        assert errors.max() < 0.3, errors.round(2)


def test_depth_and_mask_are_those_of_rays_through_the_pixel_centers(cube):
    for frame in frames_of(cube, "cube"):
        camera = frame.camera
        rays = pixel_rays(camera) @ camera.camera_to_world[:3, :3].mT
        bounds = torch.stack([(sign * HALF - camera.centers) / rays for sign in (-1, 1)])
        near, far = bounds.amin(0).amax(-1), bounds.amax(0).amin(-1)
        hit = near < far
        depth = read_depth(frame.depth.path, frame.depth.scale_adjustment)[0]
        assert ((depth > 0) == hit).double().mean() > 0.9999  # an edge may pass through a pixel's centre
        both = hit & (depth > 0)
        assert ((depth.double() / near)[both] - 1).abs().max() < 1e-3
        mask = torch.from_numpy(np.asarray(Image.open(frame.mask)).astype(float) / 255)
        assert (mask - hit.double()).abs().mean() < 0.02
        assert set(mask.unique().tolist()) >= {0.0, 1.0}


def test_place_and_scale_of_the_mesh_are_kept(cube):
    record = strict_json(cube / "rendered/cube/object.json")
    assert record["source"] == "cube.obj"
    assert record["scale"] == pytest.approx(HALF / 3, rel=1e-5)
    assert record["center"] == pytest.approx([50, 10, 20], abs=1e-4)  # OBJ's y axis becomes z


def reasons(tmp_path: Path) -> dict[str, str]:
    """Write thirteen meshes that cannot be rendered; return a part of each one's reason."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name in ("bad.glb", "bad.fbx", "bad.usd", "bad.ply", "bad.stl", "bad.obj"):
        (folder / name).write_bytes(b"no mesh")
    meshes.write_gltf(folder / "texture.gltf", "gone.png")
    meshes.write_triangle(folder / "material.obj", vertices="mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n")
    meshes.write_triangle(folder / "nan.obj", vertices="v 0 0 0\nv nan 0 0\nv 0 1 0\n")
    meshes.write_ply(folder / "nan.ply", [[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]])
    meshes.write_usd(folder / "nan.usda", "0 nan 0")
    meshes.write_triangle(folder / "point.obj", vertices="v 1 1 1\nv 1 1 1\nv 1 1 1\n")
    with (folder / "huge.glb").open("wb") as file:
        file.truncate(2_000_000_000)
    imported = "Blender cannot import it"
    return {
        **{f"bad.{suffix}": imported for suffix in ("glb", "fbx", "usd", "stl")},
        "bad.ply": "not a point cloud",
        "bad.obj": "no faces",
        "texture": "its texture gone.png is missing",
        "material": "its material file gone.mtl is missing",
        "nan.obj": "it has vertices that are not finite",
        "nan.usda": "it has vertices that are not finite",
        "nan.ply": "it has vertices that are not finite",
        "point": "all its vertices are in one place",
        "huge": "2,000 MB, more than max_megabytes=500",
    }


def test_broken_meshes_are_reported_and_left_out(tmp_path, caplog):
    expected = reasons(tmp_path)
    meshes.write_cube(tmp_path / "meshes/sub/good.obj")
    category = render(str(tmp_path / "meshes"), out=tmp_path / "data", **QUICK)
    broken = json.loads((category / "broken.json").read_text())
    assert broken.keys() == expected.keys()
    assert {name: broken[name] for name in broken if expected[name] not in broken[name]} == {}
    assert all("\n" not in reason and len(reason) < 200 for reason in broken.values())
    assert [path.name for path in category.iterdir() if path.is_dir()] == ["sub_good"]
    # What is put right is rendered the next time.
    meshes.write_cube(tmp_path / "meshes/bad.obj")
    render(str(tmp_path / "meshes"), out=tmp_path / "data", **QUICK)
    assert len(frames_of(tmp_path / "data", "bad.obj")) == QUICK["views"]


@pytest.fixture(scope="module")
def cubes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three meshes in `meshes`, and their renders in `data`."""
    root = tmp_path_factory.mktemp("cubes")
    for number in range(3):
        meshes.write_cube(root / f"meshes/{number}/cube.obj", half=number + 1)
    render(str(root / "meshes"), out=root / "data", **QUICK)
    return root


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_renders_that_were_killed_continue_without_half_written_scenes(cubes, tmp_path, number):
    given = [f"{key}={QUICK[key]}" for key in QUICK.keys() - {"factory", "front"}]
    command = ["data", "render", f"meshes={cubes / 'meshes'}", f"out={tmp_path}", *given]
    process = subprocess.Popen([sys.executable, "-P", "-m", "completesplat", *command], start_new_session=True)
    category = tmp_path / "rendered"
    done, begun = "[!.]*/object.json", ".*/renderer/job.json"
    assert waited_for(lambda: process.poll() is not None or (any(category.glob(done)) and any(category.glob(begun))))
    assert process.returncode is None  # it has not ended by itself
    os.kill(process.pid, number)
    process.wait()

    def session() -> list[int]:
        pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
        return [pid for pid in pids if _session_of(pid) == process.pid]

    assert waited_for(lambda: not session())  # Blender ends, too
    before = {path.parent.name: contents(path.parent) for path in category.glob(done)}
    assert 0 < len(before) < 3
    assert all(len([name for name in files if name.startswith("images/")]) == 3 for files in before.values())
    render(str(cubes / "meshes"), out=tmp_path, **QUICK)
    assert not list(category.glob(".*"))
    assert contents(category) == contents(cubes / "data/rendered")  # as if nothing had happened


def _session_of(pid: int) -> int | None:
    try:
        return os.getsid(pid)
    except OSError:
        return None


def test_images_do_not_depend_on_the_other_meshes_or_on_the_number_of_workers(cubes, tmp_path):
    meshes.write_cube(tmp_path / "meshes/1/cube.obj", half=2)
    meshes.write_cube(tmp_path / "meshes/cube.obj", half=2)
    category = render(str(tmp_path / "meshes"), out=tmp_path / "data", **QUICK | {"workers": 2})
    assert contents(category / "1_cube") == contents(cubes / "data/rendered/1_cube")
    images = [(category / name / "images/frame000001.jpg").read_bytes() for name in ("1_cube", "cube")]
    assert images[0] != images[1]


def test_all_commands_read_renders(command, cubes, tmp_path):
    given = ["data=rendered", f"data.root={cubes / 'data'}", "data.image_size=32"]
    for task, file in {"check": "check.json", "stats": "stats.png", "show": "show.png"}.items():
        command.succeeds("data", task, *given, f"out={tmp_path / task}")
        assert (tmp_path / task / file).is_file()
    assert strict_json(tmp_path / "check/check.json")["refused"] == []
    assert command("data", "prepare", *given, "workers=1", f"out={tmp_path / 'store'}").status == 0
    packed = ["data=rendered", f"data.root={tmp_path / 'store'}", "data.image_size=32"]
    assert command("data", "check", *packed, f"out={tmp_path / 'packed'}").status == 0
    small = [*SMALL, "data.batch_size=1", "data.targets=2", "data.workers=0", "callbacks.images=null"]
    command.succeeds("fit", "experiment=toy_var", *given, *small, f"out={tmp_path / 'run'}")
    assert strict_json(tmp_path / "run/metrics.json")["steps"] == 2


def test_the_object_lies_within_its_depth_range_and_depth_is_read(cubes):
    data = RenderedDataModule(str(cubes / "data"), image_size=32, batch_size=1)
    sequence = data.source("test").read(data.source("test").names[0])
    for view, (near, far) in enumerate(sequence.depth_ranges.tolist()):
        foreground = sequence.read_depth(view)[sequence.read(view).mask == 255]
        assert near < foreground.min() < foreground.max() < far


def test_surroundings_show_the_textures_of_a_folder_and_walls_hide_the_sky(tmp_path):
    meshes.write_cube(tmp_path / "meshes/cube.obj")
    (tmp_path / "red").mkdir()
    Image.new("RGB", (8, 8), (200, 0, 0)).save(tmp_path / "red/red.png")
    red, settings = str(tmp_path / "red"), QUICK | {"cameras": "hemisphere"}
    category = render(str(tmp_path / "meshes"), out=tmp_path / "data", **settings | {"floor": red, "wall": red})
    folder = category / "cube"
    for image, mask in zip(sorted(folder.glob("images/*")), sorted(folder.glob("masks/*")), strict=True):
        pixels = np.asarray(Image.open(image)).astype(float)[np.asarray(Image.open(mask)) == 0]
        assert (pixels[:, 0] > 1.5 * pixels[:, 1:].max(axis=1)).mean() > 0.98


def test_an_environment_map_lights_object_and_sky(tmp_path):
    meshes.write_cube(tmp_path / "meshes/cube.obj")
    green = bytes([8, 128, 8, 128])  # red, green, blue and their common exponent: 1/32, 1/2, 1/32
    (tmp_path / "sky.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + 8 * green)
    settings = QUICK | {"light": str(tmp_path / "sky.hdr"), "floor": "none"}
    category = render(str(tmp_path / "meshes"), out=tmp_path / "data", **settings)
    for image in (category / "cube/images").iterdir():
        pixels = np.asarray(Image.open(image)).astype(float)
        bright = pixels[pixels.max(axis=-1) > 60]
        assert len(bright) > 300
        assert (bright[:, 1] > 1.5 * bright[:, [0, 2]].max(axis=1)).mean() > 0.95


def test_paint_of_the_back_changes_its_pixels_from_behind_and_none_from_the_front(tmp_path):
    meshes.write_cube(tmp_path / "meshes/cube.obj")
    settings = QUICK | {"views": 6, "floor": "plain", "front": 0.0}
    folders = {}
    for hidden in ("none", "back", "modes"):
        category = render(str(tmp_path / "meshes"), out=tmp_path / hidden, **settings | {"hidden": hidden})
        folders[hidden] = category / "cube"
    plain, back, modes = folders.values()
    drawn = strict_json(modes / "object.json")["hidden"]
    assert strict_json(plain / "object.json")["hidden"] is None
    assert contents(back / "images") == contents(modes / "images") == contents(modes / drawn)
    assert contents(back / "depths") == contents(modes / "depths") == contents(plain / "depths")
    front = "frame000001.jpg"
    assert {(modes / mode / front).read_bytes() for mode in PAINTS} == {(plain / "images" / front).read_bytes()}
    images = [[np.asarray(Image.open(path)) / 255 for path in sorted((modes / mode).iterdir())] for mode in PAINTS]
    differences = np.ptp(np.array(images), axis=0).max(axis=-1)
    masks = np.array([np.asarray(Image.open(path)) for path in sorted((modes / "masks").iterdir())])
    assert (differences[2:4] > 0.1).mean(axis=(1, 2)).min() > 0.05
    assert (differences[masks == 0] > 0.1).mean() < 0.01  # neither floor nor sky, but for JPEG's edges


def test_procedural_objects_of_infinigen_are_made_by_number(tmp_path):
    settings = QUICK | {"factory": "SofaFactory", "count": 1, "views": 2}
    with pytest.raises(CompleteSplatError, match=r"^factory=CouchFactory: .*(lacks|has no) ") as caught:
        render(None, out=tmp_path, **settings | {"factory": "CouchFactory"})
    if "lacks" in str(caught.value):
        pytest.skip(str(caught.value))
    category = render(None, out=tmp_path, **settings)
    record = strict_json(category / "SofaFactory_00000/object.json")
    assert record["source"] == "SofaFactory_00000"
