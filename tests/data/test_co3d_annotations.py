"""CO3D cameras against PyTorch3D's own formulas, the object's placement, and refusals of broken annotations."""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from completesplat.data.co3d_annotations import camera_from_viewpoint, object_placement, read_category
from completesplat.data.transforms import principal_square
from completesplat.errors import DataError
from completesplat.geometry.cameras import crop_resize, project

SUBSET = "fewview_train"


def random_viewpoint(rng: np.random.Generator, layout: str) -> dict:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return {
        "R": rotation.tolist(),
        "T": [0.2, -0.1, 4.0],
        "focal_length": [2.3, 2.9],
        "principal_point": [0.13, -0.21],
        "intrinsics_format": layout,
    }


def pytorch3d_pixels(viewpoint: dict, size: tuple[int, int], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """PyTorch3D's documentation, cameras.md: NDC has +x left and +y up, pixels start at the top left corner.

    Normalised by image bounds, the left border is x = 1; isotropically, the shorter side's borders are at +-1.
    """
    height, width = size
    camera = points @ np.array(viewpoint["R"]) + np.array(viewpoint["T"])
    focal, principal = np.array(viewpoint["focal_length"]), np.array(viewpoint["principal_point"])
    ndc = focal * camera[:, :2] / camera[:, 2:] + principal
    if viewpoint["intrinsics_format"] == "ndc_norm_image_bounds":
        left_border, top_border = 1.0, 1.0
    else:
        left_border, top_border = width / min(height, width), height / min(height, width)
    x = (left_border - ndc[:, 0]) / (2 * left_border) * width
    y = (top_border - ndc[:, 1]) / (2 * top_border) * height
    return np.stack([x, y], axis=-1), camera[:, 2]


@pytest.mark.parametrize("size", [(300, 400), (500, 320), (256, 256)])
@pytest.mark.parametrize("layout", ["ndc_norm_image_bounds", "ndc_isotropic"])
def test_points_land_where_pytorch3d_puts_them(layout, size):
    rng = np.random.default_rng(0)
    viewpoint, points = random_viewpoint(rng, layout), rng.normal(size=(50, 3))
    expected, expected_depth = pytorch3d_pixels(viewpoint, size, points)
    camera = camera_from_viewpoint(viewpoint, size)
    pixels, depth = project(camera, torch.from_numpy(points))
    np.testing.assert_allclose(pixels.numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(depth.numpy(), expected_depth, atol=1e-12)
    assert torch.linalg.det(camera.world_to_camera[:3, :3]).item() == pytest.approx(1)


@pytest.mark.parametrize("layout", ["ndc_norm_image_bounds", "ndc_isotropic"])
def test_the_crop_is_centred_touches_a_border_and_moves_points_linearly(layout):
    rng, size = np.random.default_rng(1), (300, 400)
    viewpoint, points = random_viewpoint(rng, layout), rng.normal(size=(50, 3))
    camera = camera_from_viewpoint(viewpoint, size)
    center = camera.intrinsics[:2, 2].tolist()
    square = principal_square(tuple(center), size)
    borders = [square.left, square.top, 400 - square.left - square.side, 300 - square.top - square.side]
    assert min(borders) == pytest.approx(0, abs=1e-9)
    cropped = crop_resize(camera, square.left, square.top, square.side, 64)
    assert cropped.intrinsics[:2, 2].tolist() == pytest.approx([32, 32])
    expected = (pytorch3d_pixels(viewpoint, size, points)[0] - [square.left, square.top]) * 64 / square.side
    np.testing.assert_allclose(project(cropped, torch.from_numpy(points))[0].numpy(), expected, atol=1e-9)


def test_an_unknown_intrinsics_format_is_refused():
    with pytest.raises(DataError, match="screen"):
        camera_from_viewpoint(random_viewpoint(np.random.default_rng(0), "screen"), (10, 10))


def test_a_principal_point_outside_of_the_image_is_refused():
    with pytest.raises(DataError, match="principal point"):
        principal_square((-1.0, 5.0), (10, 10))


def write_cloud(path: Path, points: np.ndarray) -> Path:
    vertices = np.array([tuple(p) for p in points], dtype=[(axis, "f4") for axis in "xyz"])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    return path


def test_placement_of_a_known_cloud(tmp_path):
    corners = np.array([[10 + x, 20 + y, 30 + z] for x in (-1, 1) for y in (-2, 2) for z in (-0.5, 0.5)])
    center, factor = object_placement(write_cloud(tmp_path / "cloud.ply", corners))
    assert center.tolist() == pytest.approx([10, 20, 30])
    assert factor == pytest.approx(0.57 / 2)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((5, 3)), np.array([[0, 0, 0], [1, np.nan, 0]])])
def test_a_cloud_that_gives_no_scale_is_refused(tmp_path, points):
    with pytest.raises(DataError, match=r"cloud\.ply"):
        object_placement(write_cloud(tmp_path / "cloud.ply", points))


def test_missing_and_broken_clouds_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"none\.ply"):
        object_placement(tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("not a ply")
    with pytest.raises(DataError, match=r"text\.ply"):
        object_placement(tmp_path / "text.ply")


@pytest.fixture
def copy(toy_root: Path, tmp_path: Path) -> Path:
    """A category whose annotations a test may change."""
    shutil.copytree(toy_root, tmp_path / "copy")
    return tmp_path / "copy"


def change(root: Path, name: str, edit) -> None:
    path = root / "toy_objects" / f"{name}_annotations.jgz"
    entries = json.loads(gzip.decompress(path.read_bytes()))
    edit(entries)
    path.write_bytes(gzip.compress(json.dumps(entries).encode()))


def test_frames_come_in_order_whatever_the_file_says(copy):
    change(copy, "frame", lambda entries: entries.reverse())
    for sequences in read_category(copy, "toy_objects", SUBSET).values():
        for sequence in sequences:
            assert [f.image.name for f in sequence.frames] == [f"frame{i:06d}.jpg" for i in range(1, 5)]
            assert sequence.frames[0].camera.image_size == (32, 32)


def test_sequences_without_a_scale_are_left_out_with_a_warning(copy, caplog):
    change(copy, "sequence", lambda entries: entries[0].update(point_cloud=None))
    sequences = read_category(copy, "toy_objects", SUBSET)
    assert {split: len(members) for split, members in sequences.items()} == {"train": 1, "val": 1, "test": 1}
    assert "00000" in caplog.text


@pytest.mark.parametrize("path", ["../outside.jpg", "/etc/passwd", "toy_objects/../../outside.jpg"])
@pytest.mark.parametrize("key", ["image", "mask"])
def test_paths_that_lead_outside_are_refused(copy, path, key):
    change(copy, "frame", lambda entries: entries[0][key].update(path=path))
    with pytest.raises(DataError, match="outside"):
        read_category(copy, "toy_objects", SUBSET)


def test_a_point_cloud_outside_is_refused(copy):
    change(copy, "sequence", lambda entries: entries[0]["point_cloud"].update(path="../cloud.ply"))
    with pytest.raises(DataError, match="outside"):
        read_category(copy, "toy_objects", SUBSET)


@pytest.mark.parametrize("key", ["viewpoint", "image", "mask"])
def test_frames_with_missing_fields_are_refused_by_name(copy, key):
    change(copy, "frame", lambda entries: entries[0].update({key: None}))
    with pytest.raises(DataError, match="frame 0"):
        read_category(copy, "toy_objects", SUBSET)


def test_missing_categories_and_lists_are_refused(toy_root):
    with pytest.raises(DataError, match="no_such"):
        read_category(toy_root, "no_such", SUBSET)
    with pytest.raises(DataError, match=r"set_lists_other\.json"):
        read_category(toy_root, "toy_objects", "other")


def test_a_truncated_annotation_file_is_refused(copy):
    path = copy / "toy_objects" / "frame_annotations.jgz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=r"frame_annotations\.jgz"):
        read_category(copy, "toy_objects", SUBSET)
