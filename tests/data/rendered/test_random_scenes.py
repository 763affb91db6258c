"""Random cameras, light and surfaces of rendered scenes, and cameras of a `transforms.json`."""

import json
import math
from unittest.mock import Mock

import meshes
import numpy as np
import pytest
import torch
from support import change_json, write_capture

from completesplat.data.captures.transforms_json import read_cameras, read_transforms
from completesplat.data.rendered import rendering
from completesplat.data.rendered.assets import BrokenMesh, check_named_files, find_meshes
from completesplat.data.rendered.random_scenes import (
    PAINTS,
    draw_back,
    draw_cameras,
    draw_light,
    draw_surface,
    fixed_cameras,
    room_size,
    textures_of,
)
from completesplat.data.rendered.rendering import OBJECT
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.tensors import stack


def drawn(kind: str, seed: int, views: int = 24) -> Cameras:
    return stack(draw_cameras(np.random.default_rng(seed), kind, views, [40, 50], 64))


@pytest.mark.parametrize("kind", ["turn", "hemisphere"])
def test_cameras_stand_level_above_the_ground_and_see_most_of_the_object(kind):
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    for seed in range(20):
        cameras = drawn(kind, seed)
        assert (cameras.centers[:, 2] > 0).all()
        assert cameras.world_to_camera[:, 0, 2].abs().max() < 1e-9  # x is level
        assert (cameras.world_to_camera[:, 1, 2] < 0).all()  # y points down
        pixels, depth = project(cameras, 0.85 * directions.double())
        assert (depth > 0).all()
        assert ((pixels > 0) & (pixels < 64)).all(-1).double().mean() > 0.9
        focal = cameras.intrinsics[:, 0, 0]
        assert (focal == focal[0]).all()
        assert 40 <= math.degrees(2 * math.atan(32 / focal[0])) <= 50
        assert room_size([cameras[k] for k in range(24)]) > cameras.centers[:, :2].abs().max()


def test_a_turn_goes_once_around_and_a_hemisphere_covers_all_heights():
    for seed in range(5):
        x, y = drawn("turn", seed, 36).centers.T[:2]
        steps = torch.atan2(y, x).diff().remainder(2 * math.pi)
        assert steps.min() > math.radians(4)
        assert steps.sum() == pytest.approx(2 * math.pi * 35 / 36, abs=math.radians(6))
        heights = drawn("hemisphere", seed, 1000).centers
        sines = heights[:, 2] / heights.norm(dim=-1)
        assert sines.quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist() == pytest.approx(
            [0.265, 0.5, 0.735], abs=0.05
        )
        assert sines.max() < 0.98


def test_fixed_cameras_depend_on_nothing_but_their_number_and_see_the_whole_ball():
    first, *others = draw_cameras(np.random.default_rng(0), "fixed", 24, [36, 55], 64)
    again = draw_cameras(np.random.default_rng(1), "fixed", 24, [20, 30], 64)
    assert all(torch.equal(a.world_to_camera, b.world_to_camera) for a, b in zip([first, *others], again, strict=True))
    x, y, z = (first.centers / first.centers.norm()).tolist()
    assert math.degrees(math.asin(z)) == pytest.approx(20)
    assert math.degrees(math.atan2(y, x)) == pytest.approx(30)
    elevations = [math.degrees(math.asin(camera.centers[2] / camera.centers.norm())) for camera in others]
    assert 0 <= min(elevations) < 5
    assert 55 < max(elevations) <= 60
    for camera in (first, *others):
        away = camera.centers / camera.centers.norm()
        across = torch.linalg.cross(away, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        # The ball's outline, as seen from this distance, lies nearer to the camera than its centre.
        tangent = away / camera.centers.norm() + (1 - 1 / camera.centers.norm() ** 2).sqrt() * across / across.norm()
        seen, _ = project(camera, tangent[None])
        assert seen[0].tolist() == pytest.approx([0, 32], abs=0.01) or seen[0].tolist() == pytest.approx(
            [64, 32], abs=0.01
        )
    with pytest.raises(CompleteSplatError, match="front=0: has no effect on cameras=fixed"):
        draw_cameras(np.random.default_rng(0), "fixed", 24, [36, 55], 64, front=0)
    assert len(fixed_cameras(5, 64)) == 5


def test_light_and_surfaces_are_values_that_json_holds_and_depend_on_the_generator_alone():
    for seed in range(50):
        pair = [
            json.dumps([draw_light(rng, "random"), draw_surface(rng, "random"), draw_light(rng, "a.hdr")])
            for rng in (np.random.default_rng(seed), np.random.default_rng(seed))
        ]
        assert pair[0] == pair[1]
        light, surface, _ = json.loads(pair[0])
        assert 0 < light["elevation"] < math.pi / 2
        assert np.array(surface["colors"]).min() >= 0
        assert np.array(surface["colors"]).max() <= 1
    assert draw_surface(np.random.default_rng(0), "none") is None


def test_cameras_of_a_transforms_json_are_those_that_a_capture_has(tmp_path):
    write_capture(tmp_path / "capture", frames=6)  # images of 16 x 12 pixels, and no size in the file
    path = tmp_path / "capture/transforms.json"
    change_json(path, lambda content: content | {"w": 16, "h": 12, "cx": 7.0, "cy": 6.5})
    captured = [frame.camera() for frame in sorted(read_transforms(path).frames, key=lambda frame: frame.number)]
    for camera, other in zip(read_cameras(path, 48), captured, strict=True):
        assert camera.image_size == (48, 64)
        assert torch.allclose(camera.world_to_camera, other.world_to_camera)
        assert torch.allclose(camera.intrinsics[:2], 4 * other.intrinsics[:2])
        assert camera.intrinsics[2].tolist() == [0, 0, 1]
    again = read_cameras(meshes.write_transforms(tmp_path / "again.json", captured), 12)
    assert all(torch.allclose(*pair) for pair in zip(stack(again).intrinsics, stack(captured).intrinsics, strict=True))


def test_cameras_without_a_size_are_square(tmp_path):
    write_capture(tmp_path / "capture", frames=2)
    camera = read_cameras(tmp_path / "capture/transforms.json", 32)[1]
    assert camera.image_size == (32, 32)
    assert torch.allclose(camera.intrinsics.float(), pinhole(math.degrees(0.7), 32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k1": 0.1}, "frame 0: only pinhole cameras are rendered"),
        ({"camera_angle_y": 0.9}, "frame 0: only pinhole cameras are rendered"),
        ({"fl_x": 20}, "frame 0: fl_x is in pixels, but w and h are missing"),
        ({"frames": [1, 2]}, "frame 0: must be an object with transform_matrix"),
        ({"frames": []}, "0 frames; at least 2 are rendered"),
    ],
)
def test_cameras_that_cannot_be_rendered_are_refused(tmp_path, change, message):
    write_capture(tmp_path / "capture", frames=2)
    path = tmp_path / "capture/transforms.json"
    change_json(path, lambda content: content | change)
    with pytest.raises(DataError, match=message):
        read_cameras(path, 32)


@pytest.mark.parametrize("kind", ["turn", "hemisphere"])
def test_the_first_camera_stands_before_the_front(kind, tmp_path):
    rng, aside = np.random.default_rng(0), []
    for _ in range(50):
        x, y, _ = draw_cameras(rng, kind, 8, [40, 50], 64, 120.0)[0].centers.tolist()
        aside.append(math.degrees(math.atan2(y, x)) - 120)
    assert min(aside) == pytest.approx(-45, abs=8)
    assert max(aside) == pytest.approx(45, abs=8)
    assert all(-45 <= degrees <= 45 for degrees in aside)
    with pytest.raises(CompleteSplatError, match="front=0: has no effect on cameras="):
        draw_cameras(rng, str(tmp_path / "transforms.json"), 8, [40, 50], 64, 0)


def test_paints_have_their_chances_and_no_face_of_the_unit_ball_that_the_first_camera_sees_has_one():
    rng = np.random.default_rng(0)
    first = draw_cameras(rng, "turn", 8, [40, 50], 64)[0]
    assert draw_back(rng, first, "none") is None
    backs = [draw_back(rng, first, "back") for _ in range(2000)]
    drawn = [name for back in backs for name in back["modes"]]
    for name, paint in PAINTS.items():
        assert drawn.count(name) / 2000 == pytest.approx(paint.chance, abs=0.04)
    assert set(draw_back(rng, first, "modes")["modes"]) == set(PAINTS)
    assert [back["colors"] for back in backs] == [[PAINTS[back["modes"][0]].color] for back in backs]
    generator = torch.Generator().manual_seed(0)
    points, normals = torch.nn.functional.normalize(torch.randn(2, 100_000, 3, generator=generator).double(), dim=-1)
    points *= torch.rand(100_000, 1, generator=generator)
    away = normals @ torch.tensor(backs[0]["toward"]).double() < -backs[0]["least"]
    seen = (normals * (first.centers - points)).sum(-1) > 0
    assert not (away & seen).any()
    assert (away | seen).double().mean() > 0.75  # most of what is not seen is painted


def test_an_objects_folder_has_its_name_without_the_suffix_unless_another_file_has_that_name(tmp_path):
    (tmp_path / "x").mkdir()
    for name in ("x/box0.obj", "a.b.glb", "a.b.obj", "lamp.GLB"):
        (tmp_path / name).touch()
    assert [mesh.name for mesh in find_meshes(tmp_path)] == ["a.b.glb", "a.b.obj", "lamp", "x_box0"]


def test_hidden_files_are_neither_meshes_nor_textures(tmp_path):
    for name in ("._chair.glb", "chair.glb", "._wood.jpg", "wood.jpg"):  # as in archives of macOS
        (tmp_path / name).touch()
    assert [mesh.key for mesh in find_meshes(tmp_path)] == ["chair.glb"]
    assert textures_of(tmp_path) == [str(tmp_path / "wood.jpg")]


@pytest.mark.parametrize("library", ['"t.mtl"', ".\\t.mtl", "t.mtl"])
def test_a_material_file_is_found_as_programs_write_its_name(tmp_path, library):
    (tmp_path / "a.obj").write_text(f"mtllib {library}\n")
    with pytest.raises(BrokenMesh, match=r"its material file (\./)?t\.mtl is missing"):
        check_named_files(tmp_path / "a.obj", tmp_path)
    (tmp_path / "t.mtl").touch()
    check_named_files(tmp_path / "a.obj", tmp_path)


def test_a_mesh_that_another_one_renames_is_not_twice_in_the_data(tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/chair.glb").touch()
    written = Mock()
    monkeypatch.setattr(rendering.category_writers, "write_annotations", written)
    for names in (["chair"], ["chair.glb", "chair.obj"]):
        objects = find_meshes(tmp_path / "meshes")
        for mesh in objects:
            (tmp_path / mesh.name).mkdir()
            record = {"source": mesh.key, "frames": [], "sequence": mesh.name}
            (tmp_path / mesh.name / OBJECT).write_text(json.dumps(record))
        rendering._write_lists(tmp_path, objects, {}, len(objects))
        assert written.call_args.args[2] == names
        (tmp_path / "meshes/chair.obj").touch()
