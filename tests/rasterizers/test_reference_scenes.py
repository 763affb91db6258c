"""The reference rasterizer on random scenes: exact Jacobians, sums to one, and an independent loop over pixels."""

import numpy as np
import pytest
import torch
from rasterizer_scenes import CONSTANTS, f64, render
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole, transform_points
from completesplat.rasterizers.reference import ReferenceRasterizer, project_gaussians


def random_scene(
    batch: int, view: int, count: int, seed: int, size: tuple[int, int] = (10, 14)
) -> tuple[Gaussians, Cameras]:
    """Gaussians around the origin, seen from random places by cameras with an off-centre principal point."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    gaussians = Gaussians(
        rand(batch, count, 3) * 2 - 1,
        rand(batch, count, 4) * 2 - 1,
        0.02 + 0.3 * rand(batch, count, 3),
        rand(batch, count),
        rand(batch, count, 3),
    )
    eyes = torch.nn.functional.normalize(rand(batch, view, 3) - 0.5, dim=-1) * 2.5
    poses = look_at(eyes, 0.2 * rand(batch, view, 3), f64(0.1, 1, 0.2))
    intrinsics = (pinhole(50, size[1]).double() + f64([0, 0, 1.3], [0, 0.9, -3.1], [0, 0, 0])).repeat(batch, view, 1, 1)
    return gaussians, Cameras(poses, intrinsics, size)


def test_projected_covariances_are_the_exact_jacobians_inside_the_frustum() -> None:
    """J Sigma J^T + blur with J from automatic differentiation of the homogeneous projection."""
    gaussians, cameras = random_scene(1, 1, 40, seed=1, size=(60, 80))
    scene, camera = gaussians[0], cameras[0, 0]
    centers, depths, covariances = project_gaussians(scene, camera, CONSTANTS)
    inside = ((centers >= 0) & (centers <= f64(80, 60))).all(-1) & (depths > 0.3)
    assert inside.sum() > 10

    def pixel(point: Tensor) -> Tensor:
        homogeneous = camera.intrinsics @ (camera.world_to_camera @ torch.cat([point, f64(1)]))[:3]
        return homogeneous[:2] / homogeneous[2]

    blur = 0.3 * torch.eye(2, dtype=torch.float64)
    for i in inside.nonzero().flatten().tolist():
        jacobian = torch.func.jacrev(pixel)(scene.means[i])
        assert isinstance(jacobian, Tensor)
        torch.testing.assert_close(covariances[i], jacobian @ scene.covariances()[i] @ jacobian.T + blur)
        torch.testing.assert_close(centers[i], pixel(scene.means[i]))


def test_over_puts_the_background_behind() -> None:
    gaussians, cameras = random_scene(2, 2, 30, seed=2)
    rendering = ReferenceRasterizer()(gaussians, cameras)
    torch.testing.assert_close(rendering.over(0.0), rendering.color)
    white = rendering.over(1.0)
    torch.testing.assert_close(white - rendering.color, (1 - rendering.alpha).expand_as(white))
    picture = torch.rand(2, 2, 3, 10, 14, dtype=torch.float64)
    torch.testing.assert_close(rendering.over(picture), rendering.color + (1 - rendering.alpha) * picture)


def test_a_scene_of_one_colour_over_that_colour_is_that_colour() -> None:
    """Weights and transmittance sum to one at every pixel."""
    gaussians, cameras = random_scene(1, 2, 60, seed=3)
    color = f64(0.3, 0.6, 0.8)
    painted = Gaussians(
        gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, color.expand_as(gaussians.colors)
    )
    image = ReferenceRasterizer()(painted, cameras).over(color.reshape(1, 1, 3, 1, 1))
    torch.testing.assert_close(image, color[:, None, None].expand_as(image))


def test_scenes_and_views_of_a_batch_do_not_mix() -> None:
    gaussians, cameras = random_scene(2, 3, 25, seed=4)
    together = ReferenceRasterizer()(gaussians, cameras)
    assert together.color.shape == (2, 3, 3, 10, 14)
    assert together.depth.shape == together.alpha.shape == (2, 3, 1, 10, 14)
    for b in range(2):
        for v in range(3):
            alone = render(gaussians[b], cameras[b, v])
            assert torch.equal(together[b, v].color, alone.color[0, 0])
            assert torch.equal(together[b, v].depth, alone.depth[0, 0])


def loop(gaussians: Gaussians, camera: Cameras) -> np.ndarray:
    """Colour, depth and alpha [5 height width], pixel by pixel and Gaussian by Gaussian, sharing no code."""
    height, width = camera.image_size
    pose, k = camera.world_to_camera.numpy(), camera.intrinsics.numpy()
    items = []
    for mean, (w, x, y, z), scale, opacity, color in zip(*(v.numpy() for v in vars(gaussians).values()), strict=True):
        p = pose[:3, :3] @ mean + pose[:3, 3]
        if p[2] <= 0.01:
            continue
        imaginary = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * (w * imaginary + imaginary @ imaginary) / (w * w + x * x + y * y + z * z)
        slopes = []
        for axis, extent in ((0, width), (1, height)):
            low, high = -k[axis, 2] / k[axis, axis], (extent - k[axis, 2]) / k[axis, axis]
            slopes.append(min(max(p[axis] / p[2], low - 0.15 * (high - low)), high + 0.15 * (high - low)))
        flat = np.array([[k[0, 0], 0, -k[0, 0] * slopes[0]], [0, k[1, 1], -k[1, 1] * slopes[1]]]) / p[2]
        half = flat @ pose[:3, :3] @ turn @ np.diag(scale)
        center = k[:2, :2] @ p[:2] / p[2] + k[:2, 2]
        items.append((p[2], center, np.linalg.inv(half @ half.T + 0.3 * np.eye(2)), opacity, color))
    items.sort(key=lambda item: item[0])
    image = np.zeros((5, height, width))
    for row in range(height):
        for column in range(width):
            left = 1.0
            for depth, center, precision, opacity, color in items:
                d = np.array([column + 0.5, row + 0.5]) - center
                alpha = min(0.999, opacity * np.exp(-0.5 * d @ precision @ d))
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) <= 1e-4:
                    break
                image[:, row, column] += left * alpha * np.array([*color, depth, 1.0])
                left *= 1 - alpha
    return image


@pytest.mark.parametrize("seed", range(4))
def test_a_plain_loop_over_pixels_agrees(seed: int) -> None:
    gaussians, cameras = random_scene(1, 1, 60, seed=100 + seed)
    scene = gaussians[0]
    scene.opacities[::3] = 1.0  # so that pixels stop early
    depths = transform_points(cameras[0, 0].world_to_camera, scene.means)[:, 2]
    scene.means[0] -= cameras[0, 0].world_to_camera[2, :3] * (depths[0] + 1)  # one behind the camera
    rendering = render(scene, cameras[0, 0])
    image = torch.cat([rendering.color, rendering.depth, rendering.alpha], dim=2)[0, 0]
    np.testing.assert_allclose(image.numpy(), loop(scene, cameras[0, 0]), atol=1e-10)
