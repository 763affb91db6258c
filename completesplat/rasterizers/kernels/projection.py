"""Steps of the projection and its backward pass, for 16 Gaussians at once, one in each lane.

Scalars, and lanes in the forward pass, are float64, because huge scales must not overflow.
"""

import math

import numpy as np

from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels.compilation import helper
from completesplat.rasterizers.kernels.simd import add_each, choose, columns, gathered_rows, keep, square_root, zeros

ZERO = np.float32(0)
Array = np.ndarray
three_columns = columns(3)
nine_columns = columns(9)
COLUMNS = layout.REACHED + 1
no_sums = zeros(COLUMNS)
ONE = np.float64(1)
TWO = np.float64(2)
LN2 = np.float64(math.log(2))
SMALLEST_SQUARED_NORM = np.float64(1e-24)  # of a quaternion that has a direction, as in `geometry.rotations`


@helper
def unit_quaternion(quaternion):
    """Return (w, x, y, z, 1 / norm), or the identity with 1 / norm = 0 for a zero quaternion."""
    w, x, y, z = quaternion
    squared = w * w + x * x + y * y + z * z
    inverse = keep(squared > SMALLEST_SQUARED_NORM, ONE / square_root(squared))
    return choose(inverse > 0.0, w * inverse, ONE), x * inverse, y * inverse, z * inverse, inverse


@helper
def rotation_matrix(w, x, y, z):
    """Return the 9 entries, row-major, of the rotation by a unit quaternion."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@helper
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def row_times_matrix(a, m):
    """Return a^T M for a 3-vector and a row-major 3 x 3 matrix."""
    return (
        a[0] * m[0] + a[1] * m[3] + a[2] * m[6],
        a[0] * m[1] + a[1] * m[4] + a[2] * m[7],
        a[0] * m[2] + a[1] * m[5] + a[2] * m[8],
    )


@helper
def matrix_times_column(m, a):
    """Return M a for a row-major 3 x 3 matrix and a 3-vector."""
    return dot(m[:3], a), dot(m[3:6], a), dot(m[6:9], a)


@helper
def load_nine(array, start):
    """Return nine neighbouring entries of a flat array, as float64."""
    return (
        np.float64(array[start]), np.float64(array[start + 1]), np.float64(array[start + 2]),
        np.float64(array[start + 3]), np.float64(array[start + 4]), np.float64(array[start + 5]),
        np.float64(array[start + 6]), np.float64(array[start + 7]), np.float64(array[start + 8]),
    )  # fmt: skip


@helper
def camera_point(camera, rotation, mean):
    """Return a mean in camera coordinates."""
    x, y, z = matrix_times_column(rotation, mean)
    t = layout.TRANSLATION
    return x + camera[t], y + camera[t + 1], z + camera[t + 2]


@helper
def clamp(value, low, high):
    return min(max(value, low), high)


@helper
def combine(x, a, y, b):
    """Return x a + y b for 3-vectors a, b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@helper
def image_jacobian(camera, rotation, slope_x, slope_y, inverse_z):
    """Return the rows of J W (EWA splatting, Eq. 29): d(pixel) / d(world point), at the clamped slopes x/z and y/z."""
    x_scale = camera[layout.FOCAL_X] * inverse_z
    y_scale = camera[layout.FOCAL_Y] * inverse_z
    x_depth = x_scale * clamp(slope_x, camera[layout.MIN_SLOPE_X], camera[layout.MAX_SLOPE_X])
    y_depth = y_scale * clamp(slope_y, camera[layout.MIN_SLOPE_Y], camera[layout.MAX_SLOPE_Y])
    row_x = combine(x_scale, rotation[:3], -x_depth, rotation[6:])
    return row_x, combine(y_scale, rotation[3:6], -y_depth, rotation[6:])


@helper
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def covariance_2d(a, b, blur):
    """Return (xx, xy, yy, determinant) of [a; b] [a; b]^T + blur * I, for the rows a, b of J W times the root.

    The determinant is written with the cross product (Lagrange's identity), so nothing cancels in thin ellipses.
    """
    aa = dot(a, a)
    bb = dot(b, b)
    normal = cross(a, b)
    return aa + blur, dot(a, b), bb + blur, dot(normal, normal) + blur * (aa + bb) + blur * blur


@helper
def lane_gaussians(prepared, start):
    """Return means and roots R(quaternion) diag(scales), row-major, of the Gaussians start..start + 15."""
    flat = prepared.reshape(-1)
    stride = prepared.shape[1]
    mean = three_columns(flat, stride, layout.MEAN * stride + start)
    return mean, nine_columns(flat, stride, layout.ROOT * stride + start)


@helper
def lane_sums_of_view(gradients, places, start):
    """Return the columns of these Gaussians' gradients in one view, summed over bands. REACHED counts the bands.

    Args:
        gradients, places: [band row 16] and [band lane].
    """
    sums = no_sums()
    for band in range(gradients.shape[0]):
        sums = add_each(sums, gathered_rows(gradients[band].reshape(-1), places[band], start)[:COLUMNS])
    return sums


@helper
def outer(a, b):
    """Return a b^T, row-major."""
    return (
        a[0] * b[0], a[0] * b[1], a[0] * b[2],
        a[1] * b[0], a[1] * b[1], a[1] * b[2],
        a[2] * b[0], a[2] * b[1], a[2] * b[2],
    )  # fmt: skip


@helper
def cross_of_rows(row_x, row_y, root):
    """Return a x b for the rows a, b of J W times the root: the root's cofactors times the product of J W's rows.

    If a Gaussian is a needle, a and b are almost parallel, and their direct product would lose its significant digits.
    """
    first = (root[0], root[3], root[6])
    second = (root[1], root[4], root[7])
    third = (root[2], root[5], root[8])
    normal = cross(row_x, row_y)
    return dot(cross(second, third), normal), dot(cross(third, first), normal), dot(cross(first, second), normal)


@helper
def splat_gradients(row_x, row_y, root, blur, sums):
    """Return gradients with respect to the centre (two numbers) and to the rows a, b of J W times the root.

    With T = [[U, -U SHEAR], [0, V]], so that (u, v) = T d, the inverse covariance is 2 ln(2) T^T T. Hence
    dL/dcentre = 2 ln(2) T^T (sum s u, sum s v), and dL/dcovariance = 1/2 (2 ln 2)^2 T^T S T with the symmetric
    matrix S of the sums of s u u, s u v, s v v (gsplat's backward, `Utils.cuh`, in whitened coordinates).
    """
    a = row_times_matrix(row_x, root)
    b = row_times_matrix(row_y, root)
    a_cross_b = cross_of_rows(row_x, row_y, root)
    aa = dot(a, a)
    bb = dot(b, b)
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
def view_gradients(mean, root, camera, blur, sums):
    """Return the gradients of means and roots from one view's sums: through pixel position, Jacobian and depth."""
    rotation = load_nine(camera, layout.ROTATION)
    x, y, z = camera_point(camera, rotation, mean)
    inverse_z = ONE / z
    slope_x = x * inverse_z
    slope_y = y * inverse_z
    row_x, row_y = image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
    grad_center_x, grad_center_y, grad_a, grad_b = splat_gradients(row_x, row_y, root, blur, sums)
    grad_root = add_each(outer(row_x, grad_a), outer(row_y, grad_b))
    grad_row_x = matrix_times_column(root, grad_a)
    grad_row_y = matrix_times_column(root, grad_b)

    focal_x = camera[layout.FOCAL_X]
    focal_y = camera[layout.FOCAL_Y]
    min_x = camera[layout.MIN_SLOPE_X]
    max_x = camera[layout.MAX_SLOPE_X]
    min_y = camera[layout.MIN_SLOPE_Y]
    max_y = camera[layout.MAX_SLOPE_Y]
    x_axis = rotation[:3]
    y_axis = rotation[3:6]
    z_axis = rotation[6:]
    # row_x = (focal_x / z) * (x_axis - clamped_slope_x * z_axis), and the same for y.
    along_x = dot(grad_row_x, z_axis)
    along_y = dot(grad_row_y, z_axis)
    grad_inverse_z = focal_x * (dot(grad_row_x, x_axis) - clamp(slope_x, min_x, max_x) * along_x)
    grad_inverse_z = grad_inverse_z + focal_y * (dot(grad_row_y, y_axis) - clamp(slope_y, min_y, max_y) * along_y)
    free_x = (slope_x >= min_x) & (slope_x <= max_x)
    free_y = (slope_y >= min_y) & (slope_y <= max_y)
    grad_slope_x = focal_x * grad_center_x - keep(free_x, focal_x * inverse_z * along_x)
    grad_slope_y = focal_y * grad_center_y - keep(free_y, focal_y * inverse_z * along_y)
    # slope = point / z, and d(1 / z) / dz = -1 / z^2.
    grad_z = -inverse_z * (grad_slope_x * slope_x + grad_slope_y * slope_y + grad_inverse_z * inverse_z)
    grad_point = grad_slope_x * inverse_z, grad_slope_y * inverse_z, grad_z + sums[layout.SUM_DEPTH]
    return row_times_matrix(grad_point, rotation), grad_root
