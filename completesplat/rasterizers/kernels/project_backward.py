"""From the per-view sums of `composite_backward` to the gradients of the scene's parameters."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import (
    LN2,
    ONE,
    TWO,
    camera_point,
    covariance_2d,
    dot,
    image_jacobian,
    matrix_times_column,
    nine,
    rotation_matrix,
    row_times_matrix,
    unit_quaternion,
)

Array = np.ndarray


@kernel
def project_backward(
    means: Array, quaternions: Array, scales: Array, opacities: Array, prepared: Array, cameras: Array, blur: float,
    visible: Array, gradients: Array, first: int, last: int,
    grad_means: Array, grad_quaternions: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
) -> None:  # fmt: skip
    """Chain rule through the projection for the Gaussians [first, last) of one scene, summed over its views.

    Args:
        cameras: [view 20] float64.
        visible: [view gaussian] uint8.
        gradients: [view band gaussian 16], written by `composite_backward` for the visible Gaussians.
    """
    for i in range(first, last):
        grad_mean = (0.0, 0.0, 0.0)
        grad_root = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        red, green, blue, grad_log_opacity = 0.0, 0.0, 0.0, 0.0
        reached = False
        for view in range(cameras.shape[0]):
            if visible[view, i] == 0:
                continue
            sums = band_sums(gradients, view, i)
            if sums[layout.REACHED] == 0:
                continue
            reached = True
            red += sums[0]
            green += sums[1]
            blue += sums[2]
            grad_log_opacity += sums[layout.SUM_S]
            view_mean, view_root = view_gradients(means, prepared, cameras[view], blur, i, sums)
            grad_mean = add3(grad_mean, view_mean)
            grad_root = add9(grad_root, view_root)
        grad_colors[i, 0], grad_colors[i, 1], grad_colors[i, 2] = red, green, blue
        grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = grad_mean
        if reached:
            grad_opacities[i] = grad_log_opacity / np.float64(opacities[i])
            root_backward(quaternions, scales, i, grad_root, grad_quaternions, grad_scales)
        else:
            grad_opacities[i] = 0
            grad_quaternions[i] = 0
            grad_scales[i] = 0


@helper
def add3(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@helper
def add9(a, b):
    return add3(a[:3], b[:3]) + add3(a[3:6], b[3:6]) + add3(a[6:], b[6:])


@helper
def band_sums(gradients, view, i):
    """The columns of a Gaussian's gradients, added over the bands of block rows that it reaches."""
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    reached = 0.0
    for band in range(gradients.shape[1]):
        g = gradients[view, band, i]
        if g[layout.REACHED] != 0:
            reached = 1.0
            s0 += g[0]
            s1 += g[1]
            s2 += g[2]
            s3 += g[3]
            s4 += g[4]
            s5 += g[5]
            s6 += g[6]
            s7 += g[7]
            s8 += g[8]
            s9 += g[9]
    return s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, reached


@helper
def combine(x, a, y, b):
    """x a + y b for 3-vectors a, b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@helper
def outer(a, b):
    """a b^T, row-major."""
    return (
        a[0] * b[0], a[0] * b[1], a[0] * b[2],
        a[1] * b[0], a[1] * b[1], a[1] * b[2],
        a[2] * b[0], a[2] * b[1], a[2] * b[2],
    )  # fmt: skip


@helper
def view_gradients(means, prepared, camera, blur, i, sums):
    """Gradients with respect to the mean and to the root of the covariance, from one view."""
    rotation = nine(camera, layout.ROTATION)
    slope_x, slope_y, inverse_z = camera_slopes(means, camera, rotation, i)
    row_x, row_y = image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
    root = nine(prepared[i], layout.ROOT)
    grad_center_x, grad_center_y, grad_a, grad_b = splat_gradients(row_x, row_y, root, blur, sums)
    grad_root = add9(outer(row_x, grad_a), outer(row_y, grad_b))
    grad_row_x, grad_row_y = matrix_times_column(root, grad_a), matrix_times_column(root, grad_b)
    grad_point = point_gradient(
        camera, rotation, slope_x, slope_y, inverse_z, grad_row_x, grad_row_y, grad_center_x, grad_center_y
    )
    grad_point = grad_point[0], grad_point[1], grad_point[2] + sums[layout.SUM_DEPTH]
    return row_times_matrix(grad_point, rotation), grad_root


@helper
def camera_slopes(means, camera, rotation, i):
    """(x / z, y / z, 1 / z) of mean i in camera coordinates."""
    x, y, z = camera_point(camera, rotation, means, i)
    inverse_z = ONE / z
    return x * inverse_z, y * inverse_z, inverse_z


@helper
def splat_gradients(row_x, row_y, root, blur, sums):
    """Gradients with respect to the centre (two numbers) and to the rows a, b of J W times the root.

    With T = [[U, -U SHEAR], [0, V]], so that (u, v) = T d, the inverse covariance is 2 ln(2) T^T T. Hence
    dL/dcentre = 2 ln(2) T^T (sum s u, sum s v), and dL/dcovariance = 1/2 (2 ln 2)^2 T^T S T with the symmetric
    matrix S of the sums of s u u, s u v, s v v (gsplat's backward, `Utils.cuh`, in whitened coordinates).
    """
    a, b = row_times_matrix(row_x, root), row_times_matrix(row_y, root)
    _, xy, yy, determinant = covariance_2d(a, b, blur)
    inverse_yy = ONE / yy
    shear = xy * inverse_yy
    u, v = np.sqrt(yy / (TWO * LN2 * determinant)), np.sqrt(inverse_yy / (TWO * LN2))

    factor = TWO * LN2
    grad_center_x = factor * u * sums[layout.SUM_SU]
    grad_center_y = factor * v * sums[layout.SUM_SV] - shear * grad_center_x

    # The covariance is [a; b] [a; b]^T + blur: the gradient of its rows is (2 ln 2)^2 T^T S T [a; b].
    white_a, white_b = combine(u, a, -u * shear, b), combine(v, b, 0.0, b)
    inner_a = combine(sums[layout.SUM_SUU], white_a, sums[layout.SUM_SUV], white_b)
    inner_b = combine(sums[layout.SUM_SUV], white_a, sums[layout.SUM_SVV], white_b)
    grad_a = combine(factor * factor * u, inner_a, 0.0, inner_a)
    grad_b = combine(-shear, grad_a, factor * factor * v, inner_b)
    return grad_center_x, grad_center_y, grad_a, grad_b


@helper
def point_gradient(camera, rotation, slope_x, slope_y, inverse_z, grad_row_x, grad_row_y, grad_center_x, grad_center_y):
    """Gradient with respect to the mean in camera coordinates, through its pixel position and the Jacobian."""
    focal_x, focal_y = camera[layout.FOCAL_X], camera[layout.FOCAL_Y]
    min_x, max_x = camera[layout.MIN_SLOPE_X], camera[layout.MAX_SLOPE_X]
    min_y, max_y = camera[layout.MIN_SLOPE_Y], camera[layout.MAX_SLOPE_Y]
    x_axis, y_axis, z_axis = rotation[:3], rotation[3:6], rotation[6:]
    # row_x = (focal_x / z) * (x_axis - clamped_slope_x * z_axis), and the same for y.
    along_x, along_y = dot(grad_row_x, z_axis), dot(grad_row_y, z_axis)
    clamped_x, clamped_y = min(max(slope_x, min_x), max_x), min(max(slope_y, min_y), max_y)
    grad_inverse_z = focal_x * (dot(grad_row_x, x_axis) - clamped_x * along_x)
    grad_inverse_z += focal_y * (dot(grad_row_y, y_axis) - clamped_y * along_y)
    grad_slope_x, grad_slope_y = focal_x * grad_center_x, focal_y * grad_center_y
    if slope_x >= min_x and slope_x <= max_x:
        grad_slope_x -= focal_x * inverse_z * along_x
    if slope_y >= min_y and slope_y <= max_y:
        grad_slope_y -= focal_y * inverse_z * along_y
    # slope = point / z, and d(1 / z) / dz = -1 / z^2.
    grad_z = -inverse_z * (grad_slope_x * slope_x + grad_slope_y * slope_y + grad_inverse_z * inverse_z)
    return grad_slope_x * inverse_z, grad_slope_y * inverse_z, grad_z


@helper
def root_backward(quaternions, scales, i, grad_root, grad_quaternions, grad_scales):
    """Through root = R(q / |q|) diag(scales), to the rows i of `grad_quaternions` and `grad_scales`."""
    w, x, y, z, inverse_norm = unit_quaternion(quaternions, i)
    rotation = rotation_matrix(w, x, y, z)
    a, b, c = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    n = grad_root
    grad_scales[i, 0] = rotation[0] * n[0] + rotation[3] * n[3] + rotation[6] * n[6]
    grad_scales[i, 1] = rotation[1] * n[1] + rotation[4] * n[4] + rotation[7] * n[7]
    grad_scales[i, 2] = rotation[2] * n[2] + rotation[5] * n[5] + rotation[8] * n[8]
    g = (a * n[0], b * n[1], c * n[2], a * n[3], b * n[4], c * n[5], a * n[6], b * n[7], c * n[8])
    grad_w = TWO * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    grad_x = TWO * (-TWO * x * (g[4] + g[8]) + y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]))
    grad_y = TWO * (x * (g[1] + g[3]) - TWO * y * (g[0] + g[8]) + z * (g[5] + g[7]) + w * (g[2] - g[6]))
    grad_z = TWO * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - TWO * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    # Normalisation removes the part along q (and everything for a zero quaternion, whose inverse norm is set to 0).
    along = grad_w * w + grad_x * x + grad_y * y + grad_z * z
    grad_quaternions[i, 0] = (grad_w - along * w) * inverse_norm
    grad_quaternions[i, 1] = (grad_x - along * x) * inverse_norm
    grad_quaternions[i, 2] = (grad_y - along * y) * inverse_norm
    grad_quaternions[i, 3] = (grad_z - along * z) * inverse_norm
