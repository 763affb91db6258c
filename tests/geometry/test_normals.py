"""Normals of surfaces whose normals are known."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from completesplat.geometry.cameras import Cameras, look_at, pixel_rays
from completesplat.geometry.surfaces import normals_from_depth


def camera(height: int = 12, width: int = 16) -> Cameras:
    """Off-centre, with pixels that are not square."""
    intrinsics = torch.tensor([[14.0, 0, 6], [0, 11, 7], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.eye(4, dtype=torch.float64), intrinsics, (height, width))


def plane(normal: Tensor, distance: float, view: Cameras) -> Tensor:
    """Depth of the points p with normal . p = distance."""
    return (distance / (pixel_rays(view) @ normal))[None]


def everywhere(normal: Tensor, depth: Tensor) -> Tensor:
    return normal[:, None, None].expand(3, *depth.shape[-2:])


@pytest.mark.parametrize("normal", [[0.0, 0, -1], [0, -0.6, -0.8], [0.6, 0, -0.8], [-0.36, 0.48, -0.8]])
def test_a_plane_has_one_normal_at_every_pixel(normal: list[float]) -> None:
    expected = torch.tensor(normal, dtype=torch.float64)
    depth = plane(expected, -2.0, camera())
    assert (depth > 0).all()
    torch.testing.assert_close(normals_from_depth(depth, camera()), everywhere(expected, depth))


def sphere_error(size: int) -> float:
    """Largest error inside the outline of a sphere with radius 1 around (0.2, 0.1, 4)."""
    scale = size / 32
    intrinsics = torch.tensor([[50 * scale, 0, size / 2], [0, 50 * scale, size / 2], [0, 0, 1]], dtype=torch.float64)
    view = Cameras(torch.eye(4, dtype=torch.float64), intrinsics, (size, size))
    center = torch.tensor([0.2, 0.1, 4], dtype=torch.float64)
    rays = pixel_rays(view)
    along = rays @ center
    square = rays.square().sum(-1)
    depth = ((along - (along.square() - square * (center @ center - 1)).sqrt()) / square)[None]
    normals = normals_from_depth(depth, view)
    outward = depth * rays.movedim(-1, 0) - center[:, None, None]
    inside = (rays[..., :2] * 4 - center[:2]).norm(dim=-1) < 0.6
    assert (normals[:, depth[0].isnan()] == 0).all()
    return (normals - outward)[:, inside].abs().max().item()


def test_a_spheres_normals_point_outside_with_an_error_of_second_order() -> None:
    coarse = sphere_error(32)
    fine = sphere_error(64)
    assert coarse < 0.02
    assert 3.5 < coarse / fine < 4.5


def test_all_normals_have_unit_length_and_face_the_camera() -> None:
    """Neither the unit of depth nor the camera's place matter."""
    torch.manual_seed(0)
    depth = torch.rand(2, 1, 12, 16, dtype=torch.float64) + 0.5
    view = camera()
    views = view.map(lambda tensor: tensor.expand(2, *tensor.shape))
    normals = normals_from_depth(depth, views)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones_like(normals[:, 0]))
    assert ((normals * pixel_rays(views).movedim(-1, 1)).sum(1) < 0).all()
    eye, target, up = torch.tensor([[1.0, 2, 3], [0, 0, 0], [0, 1, 0]], dtype=torch.float64)
    moved = replace(view, world_to_camera=look_at(eye, target, up))
    torch.testing.assert_close(normals_from_depth(depth[0], moved), normals[0])
    torch.testing.assert_close(normals_from_depth(1e-6 * depth[0], view), normals[0])


@pytest.mark.parametrize("missing", [0.0, -1.0, torch.nan, torch.inf])
def test_missing_depth_has_no_normal_and_leaves_its_neighbours_theirs(missing: float) -> None:
    normal = torch.tensor([0.6, 0, -0.8], dtype=torch.float64)
    depth = plane(normal, -2.0, camera())
    depth[0, 4, 5] = missing
    expected = everywhere(normal, depth).clone()
    expected[:, 4, 5] = 0
    torch.testing.assert_close(normals_from_depth(depth, camera()), expected)
    lonely = torch.full_like(depth, missing)
    lonely[0, 4, 5] = 1
    assert not normals_from_depth(lonely, camera()).any()
