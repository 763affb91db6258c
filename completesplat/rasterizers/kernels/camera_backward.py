"""From the per-view sums of `composite_backward` to the gradients of the cameras."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.project_backward import (
    band_sums,
    camera_slopes,
    point_gradient,
    splat_gradients,
)
from completesplat.rasterizers.kernels.projection import clamp, dot, image_jacobian, matrix_times_column, nine

Array = np.ndarray


@kernel
def camera_backward(
    means: Array, prepared: Array, camera: Array, blur: float, visible: Array, gradients: Array, grad_camera: Array
) -> None:
    """Chain rule from one view's Gaussians to its camera.

    Args:
        camera: [20] float64.
        visible: [gaussian] uint8.
        gradients: [1 band gaussian 16], written by `composite_backward` for the visible Gaussians.
        grad_camera: [16] float64, receives the gradients of the first 16 columns of `camera`.
    """
    grad_camera[:] = 0
    rotation = nine(camera, layout.ROTATION)
    for i in range(means.shape[0]):
        if visible[i] == 0:
            continue
        sums = band_sums(gradients, 0, i)
        if sums[layout.REACHED] == 0:
            continue
        slope_x, slope_y, inverse_z = camera_slopes(means, camera, rotation, i)
        row_x, row_y = image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
        root = nine(prepared[i], layout.ROOT)
        grad_center_x, grad_center_y, grad_a, grad_b = splat_gradients(row_x, row_y, root, blur, sums)
        grad_row_x, grad_row_y = matrix_times_column(root, grad_a), matrix_times_column(root, grad_b)
        grad_x, grad_y, grad_z = point_gradient(
            camera, rotation, slope_x, slope_y, inverse_z, grad_row_x, grad_row_y, grad_center_x, grad_center_y
        )
        grad_point = grad_x, grad_y, grad_z + sums[layout.SUM_DEPTH]
        for axis in range(3):
            grad_camera[layout.TRANSLATION + axis] += grad_point[axis]
            for column in range(3):
                grad_camera[layout.ROTATION + 3 * axis + column] += grad_point[axis] * means[i, column]
        add_axis(grad_camera, camera, rotation, 0, slope_x, inverse_z, grad_row_x, grad_center_x)
        add_axis(grad_camera, camera, rotation, 1, slope_y, inverse_z, grad_row_y, grad_center_y)


@helper
def add_axis(grad_camera, camera, rotation, axis, slope, inverse_z, grad_row, grad_center):
    """What the image's x (0) or y (1) axis adds, through the centre and the Jacobian's row.

    The centre is focal * slope + principal; the row is focal / z * (R_axis - s R_z), where s is the slope between its
    limits. At a limit s is (constant - principal) / focal, so that it depends on the intrinsics, too.
    """
    focal = camera[layout.FOCAL_X + axis]
    low, high = camera[layout.MIN_SLOPE_X + 2 * axis], camera[layout.MAX_SLOPE_X + 2 * axis]
    s = clamp(slope, low, high)
    along = dot(grad_row, rotation[6:])
    grad_focal = grad_center * slope
    grad_principal = grad_center
    across = grad_row[0] * rotation[3 * axis] + grad_row[1] * rotation[3 * axis + 1]
    across += grad_row[2] * rotation[3 * axis + 2]
    grad_focal += inverse_z * (across - s * along)
    if slope < low or slope > high:
        grad_focal += inverse_z * along * s
        grad_principal += inverse_z * along
    grad_camera[layout.FOCAL_X + axis] += grad_focal
    grad_camera[layout.PRINCIPAL_X + axis] += grad_principal
    scale = focal * inverse_z
    for column in range(3):
        grad_camera[layout.ROTATION + 3 * axis + column] += scale * grad_row[column]
        grad_camera[layout.ROTATION + 6 + column] -= scale * s * grad_row[column]
