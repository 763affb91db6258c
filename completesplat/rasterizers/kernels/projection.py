"""Helpers shared by the projection and its backward pass. Scalars are float64: huge scales must not overflow."""

import math

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper

ONE, TWO = np.float64(1), np.float64(2)
LN2 = np.float64(math.log(2))
SMALLEST_SQUARED_NORM = np.float64(1e-24)  # of a quaternion that has a direction, as in `geometry.rotations`


@helper
def unit_quaternion(quaternions, i):
    """(w, x, y, z, 1 / norm) of row i; the identity with 1 / norm = 0 for a zero quaternion."""
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    squared = w * w + x * x + y * y + z * z
    if squared > SMALLEST_SQUARED_NORM:
        inverse = ONE / math.sqrt(squared)
        return w * inverse, x * inverse, y * inverse, z * inverse, inverse
    return ONE, 0.0, 0.0, 0.0, 0.0


@helper
def rotation_matrix(w, x, y, z):
    """The 9 entries, row-major, for a unit quaternion."""
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
    """a^T M for a 3-vector and a row-major 3 x 3 matrix."""
    return (
        a[0] * m[0] + a[1] * m[3] + a[2] * m[6],
        a[0] * m[1] + a[1] * m[4] + a[2] * m[7],
        a[0] * m[2] + a[1] * m[5] + a[2] * m[8],
    )


@helper
def matrix_times_column(m, a):
    """M a for a row-major 3 x 3 matrix and a 3-vector."""
    return dot(m[:3], a), dot(m[3:6], a), dot(m[6:9], a)


@helper
def nine(array, start):
    """Nine neighbouring entries of a flat array, as float64."""
    return (
        np.float64(array[start]), np.float64(array[start + 1]), np.float64(array[start + 2]),
        np.float64(array[start + 3]), np.float64(array[start + 4]), np.float64(array[start + 5]),
        np.float64(array[start + 6]), np.float64(array[start + 7]), np.float64(array[start + 8]),
    )  # fmt: skip


@helper
def camera_point(camera, rotation, mean):
    """A mean in camera coordinates."""
    x, y, z = matrix_times_column(rotation, mean)
    t = layout.TRANSLATION
    return x + camera[t], y + camera[t + 1], z + camera[t + 2]


@helper
def clamp(value, low, high):
    return min(max(value, low), high)


@helper
def image_jacobian(camera, rotation, slope_x, slope_y, inverse_z):
    """Rows of J W (EWA splatting, Eq. 29): d(pixel) / d(world point), at the clamped slopes x/z and y/z."""
    x_scale, y_scale = camera[layout.FOCAL_X] * inverse_z, camera[layout.FOCAL_Y] * inverse_z
    x_depth = x_scale * clamp(slope_x, camera[layout.MIN_SLOPE_X], camera[layout.MAX_SLOPE_X])
    y_depth = y_scale * clamp(slope_y, camera[layout.MIN_SLOPE_Y], camera[layout.MAX_SLOPE_Y])
    row_x = (
        x_scale * rotation[0] - x_depth * rotation[6],
        x_scale * rotation[1] - x_depth * rotation[7],
        x_scale * rotation[2] - x_depth * rotation[8],
    )
    row_y = (
        y_scale * rotation[3] - y_depth * rotation[6],
        y_scale * rotation[4] - y_depth * rotation[7],
        y_scale * rotation[5] - y_depth * rotation[8],
    )
    return row_x, row_y


@helper
def covariance_2d(a, b, blur):
    """(xx, xy, yy, determinant) of [a; b] [a; b]^T + blur * I, for the rows a, b of J W times the root.

    The determinant is written with the cross product (Lagrange's identity), so nothing cancels in thin ellipses.
    """
    aa, bb = dot(a, a), dot(b, b)
    cross = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return aa + blur, dot(a, b), bb + blur, dot(cross, cross) + blur * (aa + bb) + blur * blur
