"""Chain rule through the projection of 16 Gaussians at once, one to a lane, and through the cameras."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import (
    LN2,
    ONE,
    TWO,
    camera_point,
    clamp,
    dot,
    image_jacobian,
    matrix_times_column,
    nine,
    row_times_matrix,
)
from completesplat.rasterizers.kernels.simd import (
    LANES,
    any_lane,
    gather,
    keep,
    lane_constant,
    load,
    splat,
    square_root,
    store,
    transpose,
)

ZERO = np.float32(0)
Array = np.ndarray
lane_index = lane_constant(range(LANES))


@helper
def lane_means(means, start, last):
    """Means of the Gaussians start..start + 15, the last one again where there are no more."""
    flat = means.reshape(-1)
    return gather(flat, 3, 0, start, last), gather(flat, 3, 1, start, last), gather(flat, 3, 2, start, last)


@helper
def lane_roots(prepared, start, last):
    """R(quaternion) diag(scales) of these Gaussians, row-major."""
    flat, width, root = prepared.reshape(-1), layout.PREPARED_WIDTH, layout.ROOT
    return (
        gather(flat, width, root, start, last),
        gather(flat, width, root + 1, start, last),
        gather(flat, width, root + 2, start, last),
        gather(flat, width, root + 3, start, last),
        gather(flat, width, root + 4, start, last),
        gather(flat, width, root + 5, start, last),
        gather(flat, width, root + 6, start, last),
        gather(flat, width, root + 7, start, last),
        gather(flat, width, root + 8, start, last),
    )


@helper
def lane_sums_of_view(visible, gradients, start, last):
    """The columns of these Gaussians' gradients in one view, added over its bands; the last is REACHED, 0 or 1.

    Args:
        visible: [gaussian] float32, 1 or 0.
        gradients: [band gaussian 16]; rows of Gaussians that are not visible hold anything.
    """
    seen = gather(visible, 1, 0, start, last) > ZERO
    zero = splat(ZERO)
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, reached = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for band in range(gradients.shape[0]):
        columns = transpose(rows(gradients[band].reshape(-1), start, last))
        mask = seen & (columns[layout.REACHED] > ZERO)
        s0 = s0 + keep(mask, columns[0])
        s1 = s1 + keep(mask, columns[1])
        s2 = s2 + keep(mask, columns[2])
        s3 = s3 + keep(mask, columns[3])
        s4 = s4 + keep(mask, columns[4])
        s5 = s5 + keep(mask, columns[5])
        s6 = s6 + keep(mask, columns[6])
        s7 = s7 + keep(mask, columns[7])
        s8 = s8 + keep(mask, columns[8])
        s9 = s9 + keep(mask, columns[9])
        reached = max(reached, keep(mask, columns[layout.REACHED]))
    return s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, reached


@helper
def rows(flat, start, last):
    return (
        row(flat, start, last, 0), row(flat, start, last, 1), row(flat, start, last, 2), row(flat, start, last, 3),
        row(flat, start, last, 4), row(flat, start, last, 5), row(flat, start, last, 6), row(flat, start, last, 7),
        row(flat, start, last, 8), row(flat, start, last, 9), row(flat, start, last, 10), row(flat, start, last, 11),
        row(flat, start, last, 12), row(flat, start, last, 13), row(flat, start, last, 14), row(flat, start, last, 15),
    )  # fmt: skip


@helper
def row(flat, start, last, lane):
    return load(flat, min(start + lane, last - 1) * layout.GRADIENT_WIDTH)


@helper
def outer(a, b):
    """a b^T, row-major."""
    return (
        a[0] * b[0], a[0] * b[1], a[0] * b[2],
        a[1] * b[0], a[1] * b[1], a[1] * b[2],
        a[2] * b[0], a[2] * b[1], a[2] * b[2],
    )  # fmt: skip


@helper
def add3(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@helper
def add9(a, b):
    return add3(a[:3], b[:3]) + add3(a[3:6], b[3:6]) + add3(a[6:], b[6:])


@helper
def keep3(mask, a):
    return keep(mask, a[0]), keep(mask, a[1]), keep(mask, a[2])


@helper
def keep9(mask, a):
    return keep3(mask, a[:3]) + keep3(mask, a[3:6]) + keep3(mask, a[6:])


@helper
def combine(x, a, y, b):
    """x a + y b for 3-vectors a, b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@helper
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def cross_of_rows(row_x, row_y, root):
    """a x b for the rows a, b of J W times the root: the root's cofactors times the product of the rows of J W.

    Where a Gaussian is a needle, a and b are almost parallel, and their own product would lose all that matters.
    """
    first, second, third = (root[0], root[3], root[6]), (root[1], root[4], root[7]), (root[2], root[5], root[8])
    normal = cross(row_x, row_y)
    return dot(cross(second, third), normal), dot(cross(third, first), normal), dot(cross(first, second), normal)


@helper
def splat_gradients(row_x, row_y, root, blur, sums):
    """Gradients with respect to the centre (two numbers) and to the rows a, b of J W times the root.

    With T = [[U, -U SHEAR], [0, V]], so that (u, v) = T d, the inverse covariance is 2 ln(2) T^T T. Hence
    dL/dcentre = 2 ln(2) T^T (sum s u, sum s v), and dL/dcovariance = 1/2 (2 ln 2)^2 T^T S T with the symmetric
    matrix S of the sums of s u u, s u v, s v v (gsplat's backward, `Utils.cuh`, in whitened coordinates).
    """
    a, b = row_times_matrix(row_x, root), row_times_matrix(row_y, root)
    a_cross_b = cross_of_rows(row_x, row_y, root)
    aa, bb = dot(a, a), dot(b, b)
    determinant = dot(a_cross_b, a_cross_b) + blur * (aa + bb + blur)
    inverse_yy = ONE / (bb + blur)
    shear = dot(a, b) * inverse_yy
    v = square_root(inverse_yy / (TWO * LN2))
    u = square_root(ONE / (TWO * LN2 * determinant * inverse_yy))

    factor = TWO * LN2
    grad_center_x = factor * u * sums[layout.SUM_SU]
    grad_center_y = factor * v * sums[layout.SUM_SV] - shear * grad_center_x

    # The covariance is [a; b] [a; b]^T + blur: the gradient of its rows is (2 ln 2)^2 T^T S T [a; b]. The first row of
    # T [a; b] is U (a - SHEAR b), and (bb + blur) (a - SHEAR b) = blur a + b x (a x b).
    white_a = combine(u * inverse_yy * blur, a, u * inverse_yy, cross(b, a_cross_b))
    white_b = combine(v, b, 0.0, b)
    inner_a = combine(sums[layout.SUM_SUU], white_a, sums[layout.SUM_SUV], white_b)
    inner_b = combine(sums[layout.SUM_SUV], white_a, sums[layout.SUM_SVV], white_b)
    grad_a = combine(factor * factor * u, inner_a, 0.0, inner_a)
    grad_b = combine(-shear, grad_a, factor * factor * v, inner_b)
    return grad_center_x, grad_center_y, grad_a, grad_b


@helper
def slopes(mean, camera, rotation):
    """(x / z, y / z, 1 / z) of the means in camera coordinates."""
    x, y, z = camera_point(camera, rotation, mean)
    inverse_z = ONE / z
    return x * inverse_z, y * inverse_z, inverse_z


@helper
def row_gradients(slope_x, slope_y, inverse_z, root, camera, rotation, blur, sums):
    """Gradients with respect to the centre (two numbers), the rows of J W, and the root."""
    row_x, row_y = image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
    grad_center_x, grad_center_y, grad_a, grad_b = splat_gradients(row_x, row_y, root, blur, sums)
    grad_root = add9(outer(row_x, grad_a), outer(row_y, grad_b))
    return (
        grad_center_x,
        grad_center_y,
        matrix_times_column(root, grad_a),
        matrix_times_column(root, grad_b),
        grad_root,
    )


@helper
def point_gradient(
    camera, rotation, slope_x, slope_y, inverse_z, grad_row_x, grad_row_y, grad_center_x, grad_center_y, grad_depth
):
    """Gradient with respect to the mean in camera coordinates, through its pixel position, the Jacobian and depth."""
    focal_x, focal_y = camera[layout.FOCAL_X], camera[layout.FOCAL_Y]
    min_x, max_x = camera[layout.MIN_SLOPE_X], camera[layout.MAX_SLOPE_X]
    min_y, max_y = camera[layout.MIN_SLOPE_Y], camera[layout.MAX_SLOPE_Y]
    x_axis, y_axis, z_axis = rotation[:3], rotation[3:6], rotation[6:]
    # row_x = (focal_x / z) * (x_axis - clamped_slope_x * z_axis), and the same for y.
    along_x, along_y = dot(grad_row_x, z_axis), dot(grad_row_y, z_axis)
    grad_inverse_z = focal_x * (dot(grad_row_x, x_axis) - clamp(slope_x, min_x, max_x) * along_x)
    grad_inverse_z = grad_inverse_z + focal_y * (dot(grad_row_y, y_axis) - clamp(slope_y, min_y, max_y) * along_y)
    free_x, free_y = (slope_x >= min_x) & (slope_x <= max_x), (slope_y >= min_y) & (slope_y <= max_y)
    grad_slope_x = focal_x * grad_center_x - keep(free_x, focal_x * inverse_z * along_x)
    grad_slope_y = focal_y * grad_center_y - keep(free_y, focal_y * inverse_z * along_y)
    # slope = point / z, and d(1 / z) / dz = -1 / z^2.
    grad_z = -inverse_z * (grad_slope_x * slope_x + grad_slope_y * slope_y + grad_inverse_z * inverse_z)
    return grad_slope_x * inverse_z, grad_slope_y * inverse_z, grad_z + grad_depth


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
