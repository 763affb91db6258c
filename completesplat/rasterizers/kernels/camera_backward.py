"""From the per-view sums of `composite_backward` to the gradients of the cameras."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import clamp, dot, nine
from completesplat.rasterizers.kernels.simd import LANES, any_lane, keep, lane_constant, store
from completesplat.rasterizers.kernels.splat_backward import (
    ZERO,
    add3,
    keep3,
    lane_means,
    lane_roots,
    lane_sums_of_view,
    outer,
    point_gradient,
    row_gradients,
    slopes,
)

Array = np.ndarray

lane_index = lane_constant(range(LANES))


@kernel
def camera_backward(
    means: Array, prepared: Array, camera: Array, blur: float, visible: Array, gradients: Array, grad_camera: Array
) -> None:
    """Chain rule from one view's Gaussians to its camera.

    Args:
        camera: [20] float64.
        visible: [gaussian] float32, 1 or 0.
        gradients: [band gaussian 16], written by `composite_backward` for the visible Gaussians.
        grad_camera: [16] float64, receives the gradients of the first 16 columns of `camera`.
    """
    grad_camera[:] = 0
    count = means.shape[0]
    rotation = nine(camera, layout.ROTATION)
    totals = np.empty(LANES, np.float32)
    for start in range(0, count, LANES):
        sums = lane_sums_of_view(visible, gradients, start, count)
        # The last one is repeated where there are no more: it must count once.
        mask = (sums[layout.REACHED] > ZERO) & (lane_index() <= np.float32(count - start - 1))
        if not any_lane(mask):
            continue
        mean, root = lane_means(means, start, count), lane_roots(prepared, start, count)
        slope_x, slope_y, inverse_z = slopes(mean, camera, rotation)
        center_x, center_y, row_x, row_y, _ = row_gradients(
            slope_x, slope_y, inverse_z, root, camera, rotation, blur, sums
        )
        grad_point = point_gradient(
            camera, rotation, slope_x, slope_y, inverse_z, row_x, row_y, center_x, center_y, sums[layout.SUM_DEPTH]
        )
        x = axis_gradients(camera, rotation, 0, slope_x, inverse_z, row_x, center_x)
        y = axis_gradients(camera, rotation, 1, slope_y, inverse_z, row_y, center_y)
        r = outer(grad_point, mean)
        r_x, r_y, r_z = add3(r[:3], x[2]), add3(r[3:6], y[2]), add3(r[6:], add3(x[3], y[3]))
        rest = (keep(mask, x[0]), keep(mask, y[0]), keep(mask, x[1]), keep(mask, y[1]))
        parts = keep3(mask, r_x) + keep3(mask, r_y) + keep3(mask, r_z) + keep3(mask, grad_point) + rest
        for column in range(layout.GRAD_CAMERA_WIDTH):
            store(totals, 0, parts[column])
            # One after the other, so that a Gaussian that is left out changes nothing in the sum of the others.
            for lane in range(LANES):
                grad_camera[column] += totals[lane]


@helper
def axis_gradients(camera, rotation, axis, slope, inverse_z, grad_row, grad_center):
    """(focal, principal, R_axis, R_z): what the image's x (0) or y (1) axis adds, through the centre and J's row.

    The centre is focal * slope + principal; the row is focal / z * (R_axis - s R_z), where s is the slope between its
    limits. At a limit s is (constant - principal) / focal, so that it depends on the intrinsics, too.
    """
    low, high = camera[layout.MIN_SLOPE_X + 2 * axis], camera[layout.MAX_SLOPE_X + 2 * axis]
    s = clamp(slope, low, high)
    along = inverse_z * dot(grad_row, rotation[6:])
    across = inverse_z * dot(grad_row, (rotation[3 * axis], rotation[3 * axis + 1], rotation[3 * axis + 2]))
    limited_along = along - keep((slope >= low) & (slope <= high), along)
    grad_focal = grad_center * slope + across - s * along + s * limited_along
    scale = camera[layout.FOCAL_X + axis] * inverse_z
    grad_axis = (scale * grad_row[0], scale * grad_row[1], scale * grad_row[2])
    grad_z = (-s * grad_axis[0], -s * grad_axis[1], -s * grad_axis[2])
    return grad_focal, grad_center + limited_along, grad_axis, grad_z
