"""From the per-view sums of `composite_backward` to the gradients of the scene's parameters."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import TWO, nine, rotation_matrix, row_times_matrix, unit_quaternion
from completesplat.rasterizers.kernels.simd import LANES, any_lane, splat, store
from completesplat.rasterizers.kernels.splat_backward import (
    ZERO,
    add3,
    add9,
    keep3,
    keep9,
    lane_means,
    lane_roots,
    lane_sums_of_view,
    point_gradient,
    row_gradients,
    slopes,
)

Array = np.ndarray

# What is summed over views, before the rest of the chain rule, which is each Gaussian's own.
COLOR, LOG_OPACITY, MEAN, ROOT, REACHED, TOTALS = 0, 3, 4, 7, 16, 17


@kernel
def project_backward(
    means: Array, quaternions: Array, scales: Array, opacities: Array, prepared: Array, cameras: Array, blur: float,
    visible: Array, gradients: Array, first: int, last: int,
    grad_means: Array, grad_quaternions: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
) -> None:  # fmt: skip
    """Chain rule through the projection for the Gaussians [first, last) of one scene, summed over its views.

    Args:
        cameras: [view 20] float64.
        visible: [view gaussian] float32, 1 or 0.
        gradients: [view band gaussian 16], written by `composite_backward` for the visible Gaussians.
    """
    totals = np.empty((TOTALS, LANES), np.float32)
    for start in range(first, last, LANES):
        sum_views(means, prepared, cameras, blur, visible, gradients, start, last, totals.reshape(-1))
        for lane in range(min(LANES, last - start)):
            i = start + lane
            for axis in range(3):
                grad_colors[i, axis] = totals[COLOR + axis, lane]
                grad_means[i, axis] = totals[MEAN + axis, lane]
            if totals[REACHED, lane] > 0:
                grad_opacities[i] = np.float64(totals[LOG_OPACITY, lane]) / np.float64(opacities[i])
                grad_root = nine(totals[:, lane], ROOT)
                root_backward(quaternions, scales, i, grad_root, grad_quaternions, grad_scales)
            else:
                grad_opacities[i] = 0
                grad_quaternions[i] = 0
                grad_scales[i] = 0


@helper
def sum_views(means, prepared, cameras, blur, visible, gradients, start, last, totals):
    mean, root = lane_means(means, start, last), lane_roots(prepared, start, last)
    zero = splat(ZERO)
    red, green, blue, log_opacity, reached = zero, zero, zero, zero, zero
    grad_mean = (zero, zero, zero)
    grad_root = (zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for view in range(cameras.shape[0]):
        sums = lane_sums_of_view(visible[view], gradients[view], start, last)
        mask = sums[layout.REACHED] > ZERO
        if not any_lane(mask):
            continue
        camera = cameras[view]
        rotation = nine(camera, layout.ROTATION)
        slope_x, slope_y, inverse_z = slopes(mean, camera, rotation)
        center_x, center_y, row_x, row_y, view_root = row_gradients(
            slope_x, slope_y, inverse_z, root, camera, rotation, blur, sums
        )
        grad_point = point_gradient(
            camera, rotation, slope_x, slope_y, inverse_z, row_x, row_y, center_x, center_y, sums[layout.SUM_DEPTH]
        )
        # Of lanes that are not reached, anything may have come out, NaN included.
        grad_mean = add3(grad_mean, keep3(mask, row_times_matrix(grad_point, rotation)))
        grad_root = add9(grad_root, keep9(mask, view_root))
        red, green, blue = red + sums[0], green + sums[1], blue + sums[2]
        log_opacity = log_opacity + sums[layout.SUM_S]
        reached = max(reached, sums[layout.REACHED])
    results = (red, green, blue, log_opacity) + grad_mean + grad_root + (reached,)  # noqa: RUF005
    for k in range(TOTALS):
        store(totals, k * LANES, results[k])


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
