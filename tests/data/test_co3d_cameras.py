"""CO3D cameras and crops against PyTorch3D's own formulas."""

import numpy as np
import pytest
import torch
from co3d_trees import pytorch3d_pixels

from completesplat.data.co3d.annotations import camera_from_viewpoint
from completesplat.data.pictures.crop import principal_square
from completesplat.data.validation import BadAnnotation, BadCamera
from completesplat.geometry.cameras import crop_resize, project

LAYOUTS = ["ndc_norm_image_bounds", "ndc_isotropic"]


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


@pytest.mark.parametrize("size", [(300, 400), (500, 320), (256, 256)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_land_where_pytorch3d_puts_them(layout, size):
    rng = np.random.default_rng(0)
    viewpoint, points = random_viewpoint(rng, layout), rng.normal(size=(50, 3))
    expected, expected_depth = pytorch3d_pixels(viewpoint, size, points)
    camera = camera_from_viewpoint(viewpoint, size)
    pixels, depth = project(camera, torch.from_numpy(points))
    np.testing.assert_allclose(pixels.numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(depth.numpy(), expected_depth, atol=1e-12)
    assert torch.linalg.det(camera.world_to_camera[:3, :3]).item() == pytest.approx(1)


def test_annotations_older_than_the_format_are_normalised_by_the_bounds():
    viewpoint = random_viewpoint(np.random.default_rng(0), LAYOUTS[0])
    old = {key: value for key, value in viewpoint.items() if key != "intrinsics_format"}
    explicit, default = (camera_from_viewpoint(given, (300, 400)).intrinsics for given in (viewpoint, old))
    assert torch.equal(explicit, default)


@pytest.mark.parametrize("layout", LAYOUTS)
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
    with pytest.raises(BadAnnotation, match="screen"):
        camera_from_viewpoint(random_viewpoint(np.random.default_rng(0), "screen"), (10, 10))


def test_a_principal_point_outside_of_the_image_is_refused():
    with pytest.raises(BadCamera, match="principal point"):
        principal_square((-1.0, 5.0), (10, 10))
