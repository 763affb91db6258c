"""The reference rasterizer on random scenes: exact Jacobians, sums to one, and an independent loop over pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_scenes import CONSTANTS, draw_scene, f64, render
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.rasterizers.reference import ReferenceRasterizer, project_gaussians


def random_scene(batch: int, views: int, count: int, seed: int, size=(10, 14)) -> tuple[Gaussians, Cameras]:
    drawn = draw_scene(torch.Generator().manual_seed(seed), batch, views, size, count)
    return tuple(part.to(torch.float64) for part in drawn)


def test_projected_covariances_are_the_exact_jacobians_inside_the_frustum() -> None:
    """J Sigma J^T + blur with J from automatic differentiation of the homogeneous projection."""
    gaussians, cameras = random_scene(1, 1, 40, seed=1, size=(60, 80))
    scene = gaussians[0]
    camera = cameras[0, 0]
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
    """A scene of one colour over that colour is that colour: weights and transmittance sum to one at every pixel."""
    gaussians, cameras = random_scene(2, 2, 60, seed=2)
    rendering = ReferenceRasterizer()(gaussians, cameras)
    for background in (0.0, 1.0, torch.rand(2, 2, 3, 10, 14, dtype=torch.float64)):
        torch.testing.assert_close(rendering.over(background), rendering.color + (1 - rendering.alpha) * background)
    color = f64(0.3, 0.6, 0.8)
    image = ReferenceRasterizer()(replace(gaussians, colors=color.expand_as(gaussians.colors)), cameras)
    over = image.over(color.reshape(1, 1, 3, 1, 1))
    torch.testing.assert_close(over, color[:, None, None].expand_as(over))


def test_scenes_and_views_of_a_batch_do_not_mix() -> None:
    gaussians, cameras = random_scene(2, 3, 25, seed=4)
    together = ReferenceRasterizer()(gaussians, cameras)
    assert together.color.shape == (2, 3, 3, 10, 14)
    for b, v in np.ndindex(2, 3):
        alone = render(gaussians[b], cameras[b, v])
        for name, image in vars(alone).items():
            assert torch.equal(getattr(together[b, v], name), image[0, 0])


def loop(gaussians: Gaussians, camera: Cameras) -> np.ndarray:
    """Colour, depth and alpha [5 height width], pixel by pixel and Gaussian by Gaussian, sharing no code."""
    height, width = camera.image_size
    pose = camera.world_to_camera.numpy()
    k = camera.intrinsics.numpy()
    items = []
    for mean, (w, x, y, z), scale, opacity, color in zip(*(v.numpy() for v in vars(gaussians).values()), strict=True):
        p = pose[:3, :3] @ mean + pose[:3, 3]
        if p[2] <= 0.01:
            continue
        imaginary = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * (w * imaginary + imaginary @ imaginary) / (w * w + x * x + y * y + z * z)
        slopes = []
        for axis, extent in ((0, width), (1, height)):
            low = -k[axis, 2] / k[axis, axis]
            high = (extent - k[axis, 2]) / k[axis, axis]
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
    image = torch.cat(list(vars(render(scene, cameras[0, 0])).values()), dim=2)[0, 0]
    np.testing.assert_allclose(image.numpy(), loop(scene, cameras[0, 0]), atol=1e-10)
