"""Scene parameters to the visible Gaussians of one view, packed in depth order, and the backward pass."""

import math

import numpy as np

from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import (
    LN2,
    ONE,
    TWO,
    ZERO,
    Array,
    camera_point,
    covariance_2d,
    image_jacobian,
    lane_gaussians,
    lane_sums_of_view,
    nine,
    point_gradient,
    rotation_matrix,
    row_gradients,
    row_times_matrix,
    slopes,
    unit_quaternion,
)  # fmt: skip
from completesplat.rasterizers.kernels.simd import LANES, add_each, any_lane, keep_each, load, store, zeros
from completesplat.rasterizers.reference import LARGEST_PROJECTION

HALF = np.float64(0.5)
LARGEST_FLOAT32 = np.float32(np.finfo(np.float32).max)
RADIX_BITS = 11
BUCKETS = 1 << RADIX_BITS
PASSES = 4
# A depth as an integer that sorts alike: 8 bits of the exponent above that of the smallest normal float32 and the first
# 36 of the fraction. With a float32's 23, some neighbours in a large scene would come out in the wrong order.
SMALLEST_DEPTH_BITS = np.float64(2.0**-126).view(np.int64)
DROPPED_BITS = 8 + 52 - PASSES * RADIX_BITS
# What is summed over views, before the rest of the chain rule, which is each Gaussian's own.
COLOR, LOG_OPACITY, MEAN, ROOT, REACHED, TOTALS = 0, 3, 4, 7, 16, 17
no_totals = zeros(TOTALS)


@helper
def all_finite(row):
    finite = True
    for entry in range(row.shape[0]):
        finite &= abs(row[entry]) <= LARGEST_FLOAT32
    return finite


@kernel
def prepare(
    means: Array, quaternions: Array, scales: Array, opacities: Array, colors: Array, log2_min_alpha: float,
    prepared: Array,
) -> None:  # fmt: skip
    """Fill `prepared`; Gaussians with a value that is not finite, or too transparent ever to be seen, are marked."""
    for i in range(means.shape[0]):
        finite = all_finite(means[i]) and all_finite(quaternions[i]) and all_finite(scales[i]) and all_finite(colors[i])
        if not (finite and opacities[i] > 0 and opacities[i] <= LARGEST_FLOAT32):
            prepared[i, layout.REACH] = -1
            continue
        w, x, y, z, _ = unit_quaternion(quaternions, i)
        rotation = rotation_matrix(w, x, y, z)
        for entry in range(9):
            prepared[i, layout.ROOT + entry] = rotation[entry] * scales[i, entry % 3]
        log2_opacity = math.log2(np.float64(opacities[i]))
        prepared[i, layout.LOG2_OPACITY_PREPARED] = log2_opacity
        visible = log2_opacity >= log2_min_alpha
        prepared[i, layout.REACH] = log2_opacity - log2_min_alpha + layout.SLACK if visible else -ONE


@kernel
def project(
    means: Array, colors: Array, prepared: Array, camera: Array, height: int, width: int, blur: float,
    near_plane: float, unsorted: Array, keys: Array, order: Array, records: Array, visible: Array,
) -> int:  # fmt: skip
    """Project, cull and sort the Gaussians of one scene for one camera.

    Args:
        unsorted: scratch like `records`.
        keys, order: scratch [2 gaussian], int64 and int32.
        records: receives the visible Gaussians, front to back.
        visible: [gaussian] float32, receives 1 for these, 0 for the others.

    Returns:
        How many are visible.
    """
    count = 0
    rotation = nine(camera, layout.ROTATION)
    integers = unsorted.view(np.int32)
    for i in range(means.shape[0]):
        visible[i] = 0
        reach = np.float64(prepared[i, layout.REACH])
        if not reach > 0:
            continue
        mean = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        x, y, z = camera_point(camera, rotation, mean)
        if not (z > near_plane and z <= LARGEST_FLOAT32):
            continue
        inverse_z = ONE / z
        slope_x, slope_y = x * inverse_z, y * inverse_z
        center_x = camera[layout.FOCAL_X] * slope_x + camera[layout.PRINCIPAL_X]
        center_y = camera[layout.FOCAL_Y] * slope_y + camera[layout.PRINCIPAL_Y]
        row_x, row_y = image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
        root = nine(prepared[i], layout.ROOT)
        xx, xy, yy, determinant = covariance_2d(row_times_matrix(row_x, root), row_times_matrix(row_y, root), blur)
        # sigma = ln(2) * reach is an ellipse with these half extents.
        extent_x, extent_y = math.sqrt(2 * LN2 * reach * xx), math.sqrt(2 * LN2 * reach * yy)
        top, bottom = max(center_y - extent_y + HALF, 0.0), min(center_y + extent_y - HALF, height - ONE)
        # Written so that a NaN culls as well.
        bounded = max(abs(center_x), abs(center_y), xx, yy) <= LARGEST_PROJECTION
        inside = center_x + extent_x >= HALF and center_x - extent_x <= width - HALF and top < bottom + ONE
        if not (bounded and inside):
            continue
        inverse_yy = ONE / yy
        inverse_u = math.sqrt(2 * LN2 * determinant * inverse_yy)
        unsorted[count, layout.CENTER_X], unsorted[count, layout.CENTER_Y] = center_x, center_y
        unsorted[count, layout.U], unsorted[count, layout.INVERSE_U] = ONE / inverse_u, inverse_u
        unsorted[count, layout.SHEAR] = xy * inverse_yy
        unsorted[count, layout.V] = math.sqrt(reach) / extent_y
        unsorted[count, layout.LOG2_OPACITY] = prepared[i, layout.LOG2_OPACITY_PREPARED]
        for channel in range(3):
            unsorted[count, layout.RED + channel] = colors[i, channel]
        unsorted[count, layout.DEPTH] = z
        unsorted[count, layout.RIGHTMOST_Y] = xy / xx * extent_x
        unsorted[count, layout.EXTENT_Y] = extent_y
        integers[count, layout.ROWS] = (int(top) >> layout.BLOCK_SHIFT) | (int(bottom) >> layout.BLOCK_SHIFT << 16)
        integers[count, layout.INDEX] = i
        keys[0, count] = depth_key(z)
        visible[i] = 1
        count += 1
    radix_sort(keys, order, count)
    unsorted_flat, records_flat = unsorted.reshape(-1), records.reshape(-1)
    for j in range(count):
        source = np.int64(order[PASSES % 2, j]) * layout.RECORD_WIDTH
        store(records_flat, j * layout.RECORD_WIDTH, load(unsorted_flat, source))
    return count


@helper
def depth_key(z):
    bits = np.float64(z).view(np.int64) - SMALLEST_DEPTH_BITS
    return bits >> DROPPED_BITS if bits > 0 else 0


@helper
def radix_sort(keys, order, count):
    """Stable sort of keys[0, :count]; order[PASSES % 2] is the result."""
    starts = np.zeros((PASSES, BUCKETS), np.int32)
    for i in range(count):
        order[0, i] = i
        for digit in range(PASSES):
            starts[digit, (keys[0, i] >> (RADIX_BITS * digit)) & (BUCKETS - 1)] += 1
    for digit in range(PASSES):
        total = 0
        for bucket in range(BUCKETS):
            size = starts[digit, bucket]
            starts[digit, bucket] = total
            total += size
        source, target = digit % 2, 1 - digit % 2
        for i in range(count):
            key = keys[source, i]
            bucket = (key >> (RADIX_BITS * digit)) & (BUCKETS - 1)
            position = starts[digit, bucket]
            starts[digit, bucket] = position + 1
            keys[target, position] = key
            order[target, position] = order[source, i]


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
        gradients: [view band gaussian 16], written by `composite` for the visible Gaussians.
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
    mean, root = lane_gaussians(means, prepared, start, last)
    results = no_totals()
    for view in range(cameras.shape[0]):
        sums = lane_sums_of_view(visible[view], gradients[view], start, last)
        mask = sums[layout.REACHED] > ZERO
        if not any_lane(mask):
            continue
        camera = cameras[view]
        rotation = nine(camera, layout.ROTATION)
        slope_x, slope_y, inverse_z = slopes(mean, camera, rotation)
        center_x, center_y, row_x, row_y, grad_root = row_gradients(
            slope_x, slope_y, inverse_z, root, camera, rotation, blur, sums
        )
        grad_point = point_gradient(
            camera, rotation, slope_x, slope_y, inverse_z, row_x, row_y, center_x, center_y, sums[layout.SUM_DEPTH]
        )
        grad_mean = row_times_matrix(grad_point, rotation)
        parts = (sums[0], sums[1], sums[2], sums[layout.SUM_S]) + grad_mean + grad_root + (sums[layout.REACHED],)  # noqa: RUF005
        # Of lanes that are not reached, anything may have come out, NaN included.
        results = add_each(results, keep_each(mask, parts))
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
