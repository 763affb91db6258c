"""The camera conventions, each as a fact about points and pixels."""

import math
from dataclasses import replace

import pytest
import torch
from rasterizer_scenes import f64
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from completesplat.geometry.cameras import (
    Cameras,
    crop_resize,
    invert_rigid,
    look_at,
    mirror,
    nearest_to_axes,
    pinhole,
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
    assert_close(again, pixels, atol=1e-8, rtol=1e-10)
    assert_close(depth_again, depth)
    assert_close(unproject(cameras, again, depth_again), points)
    shared, _ = project(cameras, torch.zeros(7, 3, dtype=torch.float64))  # one set of points for all cameras
    assert_close(shared, project(cameras, torch.zeros(*batch, 7, 3, dtype=torch.float64))[0])


def test_a_point_on_the_ray_of_the_top_left_pixel_projects_to_one_half() -> None:
    cameras = random_cameras(4)
    rays = pixel_rays(cameras)
    assert rays.shape == (4, 48, 64, 3)
    points = transform_points(cameras.camera_to_world, torch.stack([rays[:, 0, 0], 3 * rays[:, -1, -1]], dim=1))
    pixels, depth = project(cameras, points)
    assert_close(pixels, f64([0.5, 0.5], [63.5, 47.5]).expand(4, 2, 2), atol=1e-9, rtol=0)
    assert_close(depth, f64(1, 3).expand(4, 2))


def test_axes_point_right_down_and_forward() -> None:
    camera = Cameras(torch.eye(4), pinhole(90, 64), (64, 64))
    pixels, depth = project(camera, torch.tensor([[0, 0, 2.0], [1, 0, 2.0], [0, 1, 2.0]]))
    assert_close(pixels, torch.tensor([[32.0, 32], [48, 32], [32, 48]]))
    assert_close(depth, torch.full((3,), 2.0))


def test_rays_have_unit_depth_and_the_principal_ray_is_the_axis() -> None:
    intrinsics, (pixels, _) = random_cameras(6).intrinsics, random_pixels(6, 10)
    assert_close(rays_through(intrinsics, intrinsics[:, None, :2, 2]), f64([0, 0, 1]).expand(6, 1, 3))
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    assert_close(rays_through(intrinsics, pixels), homogeneous @ torch.linalg.inv(intrinsics).mT)


def test_rigid_inverse_is_the_matrix_inverse() -> None:
    poses = random_poses(3, 20)
    cameras = random_cameras(5)
    assert_close(invert_rigid(poses), torch.linalg.inv(poses))
    assert_close(transform_points(cameras.world_to_camera, cameras.centers[:, None]), f64([0, 0, 0]).expand(5, 1, 3))


def assert_rotation(matrix: Tensor) -> None:
    identity = torch.eye(3, dtype=torch.float64)
    assert_close(matrix @ matrix.mT, identity.expand_as(matrix))
    assert (torch.linalg.det(matrix) > 0).all()


def test_look_at_puts_the_eye_at_the_origin_and_the_target_on_the_axis() -> None:
    eye, target, up = rand(3, 50, 3, low=-2, high=2, seed=11)
    matrix = look_at(eye, target, up)
    seen_eye, seen_target, seen_up = (transform_points(matrix, p[:, None])[:, 0] for p in (eye, target, eye + up))
    assert_close(seen_eye, torch.zeros_like(eye))
    assert_close(seen_target[:, :2], torch.zeros(50, 2, dtype=torch.float64))
    assert_close(seen_target[:, 2], (target - eye).norm(dim=-1))
    assert_close(seen_up[:, 0], torch.zeros(50, dtype=torch.float64))
    assert (seen_up[:, 1] < 0).all()
    assert_rotation(matrix[:, :3, :3])
    straight = look_at(eye, target, target - eye)  # from above, where `up` does not say how the camera is turned
    assert_rotation(straight[:, :3, :3])
    assert_close(transform_points(straight, target[:, None])[:, 0, :2], torch.zeros(50, 2, dtype=torch.float64))


def test_relative_to_makes_the_reference_the_world_and_keeps_the_poses_between_cameras() -> None:
    cameras = random_cameras(6)
    reference = random_cameras(1, seed=40)[0]
    assert_close(reference.relative_to(reference).world_to_camera, torch.eye(4, dtype=torch.float64))
    moved = cameras.relative_to(reference)
    between = cameras.world_to_camera[1:] @ cameras.camera_to_world[:-1]
    assert_close(moved.world_to_camera[1:] @ moved.camera_to_world[:-1], between)
    points = rand(9, 3, low=-2, high=2)
    in_reference = transform_points(reference.world_to_camera, points)
    assert_close(project(moved, in_reference), project(cameras, points), atol=1e-6, rtol=1e-9)


def test_scaling_the_world_scales_depths_and_leaves_pixels() -> None:
    cameras = random_cameras(4)
    points = rand(4, 30, 3, low=-2, high=2)
    factor = f64(0.1, 1, 3, 20)
    pixels, depth = project(cameras, points)
    scaled = cameras.scale_world(factor)
    scaled_pixels, scaled_depth = project(scaled, points * factor[:, None, None])
    assert_close(scaled_pixels, pixels, atol=1e-6, rtol=1e-9)
    assert_close(scaled_depth, depth * factor[:, None])
    assert_close(scaled.centers, cameras.centers * factor[:, None])


@pytest.mark.parametrize("count", [2, 5])
def test_the_place_that_cameras_look_at_is_nearest_to_their_axes(count: int) -> None:
    target = rand(3, low=-2, high=2)
    poses = look_at(target + rand(count, 3, low=-4, high=-1, seed=1), target, f64(0.0, -1, 0))
    cameras = Cameras(poses, random_cameras(count).intrinsics, (48, 64))
    point = nearest_to_axes(cameras)
    assert point is not None
    assert_close(point, target)
    parallel = replace(cameras, world_to_camera=poses[:1].repeat(count, 1, 1))
    parallel.world_to_camera[:, 0, 3] += torch.arange(count)
    assert nearest_to_axes(parallel) is None


@pytest.mark.parametrize(("left", "top", "side", "size"), [(0, 0, 48, 48), (3.5, 7.25, 30.5, 128), (-4, -2, 60, 16)])
def test_cropping_moves_and_scales_every_projection(left: float, top: float, side: float, size: int) -> None:
    cameras = random_cameras(3)
    points = rand(3, 40, 3, low=-2, high=2)
    before, depth = project(cameras, points)
    cropped = crop_resize(cameras, left, top, side, size)
    after, depth_after = project(cropped, points)
    assert_close(after, (before - f64(left, top)) * size / side, atol=1e-6, rtol=1e-9)
    assert_close(depth_after, depth)
    assert cropped.image_size == (size, size)


def test_a_mirrored_camera_sees_the_mirrored_point_mirrored() -> None:
    cameras = random_cameras(2, 3)
    points = rand(2, 3, 40, 3, low=-2, high=2)
    pixels, depth = project(cameras, points)
    mirrored = mirror(cameras)
    mirrored_pixels, mirrored_depth = project(mirrored, points * torch.tensor([-1, 1, 1]))
    expected = torch.stack([64 - pixels[..., 0], pixels[..., 1]], dim=-1)
    assert_close(mirrored_pixels, expected, atol=1e-6, rtol=1e-9)
    assert_close(mirrored_depth, depth)
    assert mirrored.image_size == cameras.image_size
    assert_close(vars(mirror(mirrored)), vars(cameras))
    assert_rotation(mirrored.world_to_camera[..., :3, :3])


@pytest.mark.parametrize(("degrees", "tangent"), [(90.0, 1.0), (60.0, 1 / math.sqrt(3)), (45.0, math.sqrt(2) - 1)])
def test_pinhole_spans_its_field_of_view(degrees: float, tangent: float) -> None:
    focal = 64 / tangent  # tan of half the angle, from its closed form
    assert_close(pinhole(degrees, 128), torch.tensor([[focal, 0, 64], [0, focal, 64], [0, 0, 1]]))
