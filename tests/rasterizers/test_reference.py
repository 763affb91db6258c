"""The reference rasterizer: where single Gaussians land and how they mix, in closed form."""

import math

import pytest
import torch
from rasterizer_scenes import CONSTANTS, f64, render

from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import project_gaussians


def straight_camera(size=(12, 16), center=(8, 6)) -> Cameras:
    intrinsics = f64([20, 0, center[0]], [0, 20, center[1]], [0, 0, 1])
    return Cameras(torch.eye(4, dtype=torch.float64), intrinsics, size)


def at_pixel(camera, column: int, row: int, depth: float, opacity: float, color: object = (1, 1, 1)) -> Gaussians:
    """A point-like Gaussian (blur only) on the centre of a pixel of a straight camera."""
    k = camera.intrinsics
    mean = f64((column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1], 1) * depth
    return Gaussians(mean[None], f64([1, 0, 0, 0]), f64([1e-6] * 3), f64(opacity), f64(color))


@pytest.mark.parametrize(
    ("size", "center", "column", "row"),
    [((12, 16), (8, 6), 0, 0), ((12, 16), (20, -3), 15, 11), ((12, 16), (8, 6), 3, 9), ((1, 7), (20, -3), 6, 0)],
)
def test_an_opaque_point_lands_on_its_pixel_with_its_colour(size, center, column, row) -> None:
    camera = straight_camera(size, center)
    rendering = render(at_pixel(camera, column, row, depth=3, opacity=1, color=(0.2, 0.5, 0.9)), camera)
    assert rendering.alpha.argmax().item() == row * size[1] + column
    torch.testing.assert_close(rendering.color[0, 0, :, row, column], 0.999 * f64(0.2, 0.5, 0.9))


def test_alpha_of_one_gaussian_in_closed_form() -> None:
    """A round Gaussian on the optical axis has the 2D variance (f s / z)^2 + blur; its neighbours follow exp."""
    camera = straight_camera(center=(8.5, 6.5))
    scale = 0.1
    depth = 2.0
    opacity = 0.8
    gaussian = Gaussians(f64([0, 0, depth]), f64([1, 2, 3, 4]), f64([scale] * 3), f64(opacity), f64([1, 0.5, 0]))
    rendering = render(gaussian, camera)
    variance = (20 * scale / depth) ** 2 + 0.3
    for column, row in [(8, 6), (9, 6), (8, 5), (10, 7), (7, 4)]:
        squared = (column - 8) ** 2 + (row - 6) ** 2
        expected = opacity * math.exp(-squared / (2 * variance))
        assert rendering.alpha[0, 0, 0, row, column].item() == pytest.approx(expected, rel=1e-12)
        assert rendering.depth[0, 0, 0, row, column].item() == pytest.approx(expected * depth, rel=1e-12)
        assert rendering.color[0, 0, 1, row, column].item() == pytest.approx(expected * 0.5, rel=1e-12)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
def test_compositing_goes_front_to_back_whatever_the_order_of_input(order: list[int]) -> None:
    """The expected depth is the mean weighted by contribution, and zero where nothing is."""
    camera = straight_camera()
    depths = (2.0, 3.0, 5.0)
    opacities = (0.5, 0.25, 0.75)
    colors = torch.eye(3).tolist()
    points = [at_pixel(camera, 4, 7, *values) for values in zip(depths, opacities, colors, strict=True)]
    rendering = render(merge_gaussians([points[i] for i in order]), camera)
    images = rendering.color, rendering.alpha, rendering.depth, rendering.expected_depth()
    weights = f64(0.5, 0.5 * 0.25, 0.5 * 0.75 * 0.75)
    alpha = 1 - 0.5 * 0.75 * 0.25
    mean = weights @ f64(*depths)
    expected = torch.cat([weights, f64(alpha, mean, mean / alpha)])
    torch.testing.assert_close(torch.cat([image[0, 0, :, 7, 4] for image in images]), expected)
    assert rendering.expected_depth()[0, 0, 0, 11, 15] == 0


def test_contributions_below_one_over_255_are_skipped() -> None:
    camera = straight_camera()
    faint, seen = (render(at_pixel(camera, 4, 7, 2, opacity), camera) for opacity in (0.9999 / 255, 1.0001 / 255))
    assert faint.alpha.max() == 0
    assert seen.alpha[0, 0, 0, 7, 4].item() == pytest.approx(1.0001 / 255, rel=1e-12)
    opaque = render(at_pixel(camera, 4, 7, 2, 1.0), camera).alpha[0, 0, 0, 7]
    # exp(-d^2 / 0.6) falls below 1 / 255 between one and two pixels from the centre.
    assert (opaque > 0).nonzero().flatten().tolist() == [3, 4, 5]


@pytest.mark.parametrize("largest", [0.999, 0.99])
def test_one_gaussian_never_hides_more_than_the_largest_alpha(largest: float) -> None:
    camera = straight_camera()
    rendering = render(at_pixel(camera, 4, 7, 2, 1.0), camera, RenderingConstants(max_alpha=largest))
    assert rendering.alpha[0, 0, 0, 7, 4].item() == pytest.approx(largest, rel=1e-12)


@pytest.mark.parametrize(("second", "takes_part"), [(0.8999, True), (0.9001, False)])
def test_the_gaussian_that_would_use_up_the_transmittance_takes_no_part(second: float, takes_part: bool) -> None:
    """After 0.999 the transmittance is 1e-3: the next alpha brings it to 1.001e-4 or to 0.999e-4."""
    camera = straight_camera()
    front = at_pixel(camera, 4, 7, 2, 1.0, (1, 0, 0))
    middle = at_pixel(camera, 4, 7, 3, second, (0, 1, 0))
    behind = at_pixel(camera, 4, 7, 4, 0.0005 + 1 / 255, (0, 0, 1))  # would fit by itself, but the pixel has stopped
    color = render(merge_gaussians([behind, middle, front]), camera).color[0, 0, :, 7, 4]
    assert color[0].item() == pytest.approx(0.999, rel=1e-12)
    assert color[1].item() == pytest.approx(0.001 * second if takes_part else 0, rel=1e-9)
    assert color[2].item() == 0


def test_nothing_is_drawn_up_to_the_near_plane() -> None:
    for depth in (-1.0, 0.0, 0.0099, 0.01, 0.0101):
        gaussian = Gaussians(f64([0, 0, depth]), f64([1, 0, 0, 0]), f64([0.1] * 3), f64(0.9), f64([1, 1, 1]))
        assert (render(gaussian, straight_camera()).alpha.max() > 0.5) == (depth > 0.01)


@pytest.mark.parametrize(("slope", "clamped"), [(1.3, 1.16), (-9.0, -0.92), (1.15, 1.15), (-0.91, -0.91)])
@pytest.mark.parametrize("axis", [0, 1])
def test_outside_the_frustum_the_jacobian_is_that_of_the_clamped_direction(slope, clamped, axis) -> None:
    """Extent 16, focal 10, principal point 6.8: the borders' slopes are -0.68 and 0.92, the margin is 0.3 * 0.8."""
    wide = Cameras(torch.eye(4, dtype=torch.float64), f64([10, 0, 6.8], [0, 10, 6.8], [0, 0, 1]), (16, 16))
    depth = 2.0
    mean = torch.zeros(3, dtype=torch.float64)
    mean[axis], mean[2] = slope * depth, depth
    gaussian = Gaussians(mean[None], f64([1, 0, 0, 0]), f64([0.1, 0.2, 0.4]), f64(0.5), f64([1, 1, 1]))
    centers, _, covariances = project_gaussians(gaussian, wide, CONSTANTS)
    assert centers[0, axis].item() == pytest.approx(10 * slope + 6.8)  # the centre itself is not clamped
    expected = (10 / depth) ** 2 * (gaussian.scales[0, axis].item() ** 2 + (clamped * 0.4) ** 2) + 0.3
    assert covariances[0, axis, axis].item() == pytest.approx(expected, rel=1e-12)
