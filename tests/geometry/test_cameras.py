"""The camera conventions, each as a fact about points and pixels."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from completesplat.geometry.cameras import (
    Cameras,
    crop_resize,
    invert_rigid,
    look_at,
    mirror,
    pinhole,
    pixel_centers,
    pixel_rays,
    project,
    rays_through,
    transform_points,
    unproject,
)


def rand(*shape: int, low: float = 0.0, high: float = 1.0, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def random_poses(*batch: int, seed: int = 0) -> Tensor:
    count = math.prod(batch)
    matrix = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    matrix[:, :3, :3] = torch.from_numpy(Rotation.random(count, rng=seed).as_matrix())
    matrix[:, :3, 3] = rand(count, 3, low=-3, high=3, seed=seed)
    return matrix.reshape(*batch, 4, 4)


def random_cameras(*batch: int, seed: int = 0, image_size: tuple[int, int] = (48, 64)) -> Cameras:
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(*batch, 1, 1)
    intrinsics[..., 0, 0] = rand(*batch, low=20, high=90, seed=seed + 1)
    intrinsics[..., 1, 1] = rand(*batch, low=20, high=90, seed=seed + 2)
    intrinsics[..., :2, 2] = rand(*batch, 2, low=10, high=50, seed=seed + 3)
    return Cameras(random_poses(*batch, seed=seed), intrinsics, image_size)


def random_pixels(*batch: int, seed: int = 9) -> tuple[Tensor, Tensor]:
    return rand(*batch, 2, low=-20, high=90, seed=seed), rand(*batch, low=0.1, high=9, seed=seed + 1)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_project_and_unproject_undo_each_other(batch: tuple[int, ...]) -> None:
    cameras = random_cameras(*batch) if batch else random_cameras(1)[0]
    pixels, depth = random_pixels(*batch, 200)
    points = unproject(cameras, pixels, depth)
    again, depth_again = project(cameras, points)
    torch.testing.assert_close(again, pixels, atol=1e-8, rtol=1e-10)
    torch.testing.assert_close(depth_again, depth)
    torch.testing.assert_close(unproject(cameras, again, depth_again), points)
    shared, _ = project(cameras, torch.zeros(7, 3, dtype=torch.float64))  # one set of points for all cameras
    torch.testing.assert_close(shared, project(cameras, torch.zeros(*batch, 7, 3, dtype=torch.float64))[0])


def test_a_point_on_the_ray_of_the_top_left_pixel_projects_to_one_half() -> None:
    cameras = random_cameras(4)
    rays = pixel_rays(cameras)
    assert rays.shape == (4, 48, 64, 3)
    points = transform_points(cameras.camera_to_world, torch.stack([rays[:, 0, 0], 3 * rays[:, -1, -1]], dim=1))
    pixels, depth = project(cameras, points)
    expected = torch.tensor([[0.5, 0.5], [63.5, 47.5]], dtype=torch.float64).expand(4, 2, 2)
    torch.testing.assert_close(pixels, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(depth, torch.tensor([1.0, 3.0], dtype=torch.float64).expand(4, 2))


def test_axes_point_right_down_and_forward() -> None:
    camera = Cameras(torch.eye(4), pinhole(90, 64), (64, 64))
    pixels, depth = project(camera, torch.tensor([[0, 0, 2.0], [1, 0, 2.0], [0, 1, 2.0]]))
    torch.testing.assert_close(pixels, torch.tensor([[32.0, 32], [48, 32], [32, 48]]))
    torch.testing.assert_close(depth, torch.full((3,), 2.0))


def test_pixel_centers_are_column_then_row() -> None:
    centers = pixel_centers(3, 5, dtype=torch.float64)
    assert centers.shape == (3, 5, 2)
    assert centers.dtype == torch.float64
    assert centers[2, 4].tolist() == [4.5, 2.5]
    assert centers[2, 0].tolist() == [0.5, 2.5]


def test_rays_have_unit_depth_and_the_principal_ray_is_the_axis() -> None:
    intrinsics = random_cameras(6).intrinsics
    axis = rays_through(intrinsics, intrinsics[:, None, :2, 2])
    torch.testing.assert_close(axis, torch.tensor([0, 0, 1.0], dtype=torch.float64).expand(6, 1, 3))
    pixels, _ = random_pixels(6, 10)
    homogeneous = torch.cat([pixels, torch.ones(6, 10, 1, dtype=torch.float64)], dim=-1)
    torch.testing.assert_close(rays_through(intrinsics, pixels), homogeneous @ torch.linalg.inv(intrinsics).mT)


def test_rigid_inverse_is_the_matrix_inverse() -> None:
    poses = random_poses(3, 20)
    torch.testing.assert_close(invert_rigid(poses), torch.linalg.inv(poses))
    cameras = random_cameras(5)
    centers = transform_points(cameras.world_to_camera, cameras.centers[:, None])
    torch.testing.assert_close(centers, torch.zeros_like(centers))


def test_look_at_puts_the_eye_at_the_origin_and_the_target_on_the_axis() -> None:
    eye, target, up = rand(3, 50, 3, low=-2, high=2, seed=11)
    matrix = look_at(eye, target, up)
    seen_eye, seen_target, seen_up = (transform_points(matrix, p[:, None])[:, 0] for p in (eye, target, eye + up))
    torch.testing.assert_close(seen_eye, torch.zeros_like(eye))
    torch.testing.assert_close(seen_target[:, :2], torch.zeros(50, 2, dtype=torch.float64))
    torch.testing.assert_close(seen_target[:, 2], (target - eye).norm(dim=-1))
    torch.testing.assert_close(seen_up[:, 0], torch.zeros(50, dtype=torch.float64))
    assert (seen_up[:, 1] < 0).all()
    rotation = matrix[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(50, dtype=torch.float64))


def test_relative_to_makes_the_reference_the_world_and_keeps_the_poses_between_cameras() -> None:
    cameras, reference = random_cameras(6), random_cameras(1, seed=40)[0]
    torch.testing.assert_close(reference.relative_to(reference).world_to_camera, torch.eye(4, dtype=torch.float64))
    moved = cameras.relative_to(reference)
    between = cameras.world_to_camera[1:] @ cameras.camera_to_world[:-1]
    torch.testing.assert_close(moved.world_to_camera[1:] @ moved.camera_to_world[:-1], between)
    points = rand(9, 3, low=-2, high=2)
    in_reference = transform_points(reference.world_to_camera, points)
    torch.testing.assert_close(project(moved, in_reference), project(cameras, points), atol=1e-6, rtol=1e-9)


def test_scaling_the_world_scales_depths_and_leaves_pixels() -> None:
    cameras, points = random_cameras(4), rand(4, 30, 3, low=-2, high=2)
    factor = torch.tensor([0.1, 1.0, 3.0, 20.0], dtype=torch.float64)
    pixels, depth = project(cameras, points)
    scaled_pixels, scaled_depth = project(cameras.scale_world(factor), points * factor[:, None, None])
    torch.testing.assert_close(scaled_pixels, pixels, atol=1e-6, rtol=1e-9)
    torch.testing.assert_close(scaled_depth, depth * factor[:, None])
    torch.testing.assert_close(cameras.scale_world(factor).centers, cameras.centers * factor[:, None])


@pytest.mark.parametrize(("left", "top", "side", "size"), [(0, 0, 48, 48), (3.5, 7.25, 30.5, 128), (-4, -2, 60, 16)])
def test_cropping_moves_and_scales_every_projection(left: float, top: float, side: float, size: int) -> None:
    cameras, points = random_cameras(3), rand(3, 40, 3, low=-2, high=2)
    before, depth = project(cameras, points)
    cropped = crop_resize(cameras, left, top, side, size)
    after, depth_after = project(cropped, points)
    corner = torch.tensor([left, top], dtype=torch.float64)
    torch.testing.assert_close(after, (before - corner) * size / side, atol=1e-6, rtol=1e-9)
    torch.testing.assert_close(depth_after, depth)
    assert cropped.image_size == (size, size)


def test_a_mirrored_camera_sees_the_mirrored_point_mirrored() -> None:
    cameras, points = random_cameras(2, 3), rand(2, 3, 40, 3, low=-2, high=2)
    pixels, depth = project(cameras, points)
    mirrored = mirror(cameras)
    mirrored_pixels, mirrored_depth = project(mirrored, points * torch.tensor([-1, 1, 1]))
    expected = torch.stack([64 - pixels[..., 0], pixels[..., 1]], dim=-1)
    torch.testing.assert_close(mirrored_pixels, expected, atol=1e-6, rtol=1e-9)
    torch.testing.assert_close(mirrored_depth, depth)
    assert mirrored.image_size == cameras.image_size
    torch.testing.assert_close(vars(mirror(mirrored)), vars(cameras))
    rotation = mirrored.world_to_camera[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(2, 3, dtype=torch.float64))


@pytest.mark.parametrize(("degrees", "tangent"), [(90.0, 1.0), (60.0, 1 / math.sqrt(3)), (45.0, math.sqrt(2) - 1)])
def test_pinhole_spans_its_field_of_view(degrees: float, tangent: float) -> None:
    intrinsics = pinhole(degrees, 128)
    focal = 64 / tangent  # tan of half the angle, from its closed form
    torch.testing.assert_close(intrinsics, torch.tensor([[focal, 0, 64], [0, focal, 64], [0, 0, 1]]))
    edges = rays_through(intrinsics, torch.tensor([[0.0, 64.0], [128.0, 64.0]]))
    angle = math.degrees(math.acos(torch.cosine_similarity(edges[0], edges[1], dim=0).item()))
    assert angle == pytest.approx(degrees, abs=1e-4)
