"""Projection of a scene to the visible Gaussians of one view, packed in depth order, and its backward pass."""

import math

import numpy as np
from llvmlite import ir
from numba.core import types

from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels import projection, simd
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.projection import LN2, ONE, TWO, ZERO, Array
from completesplat.rasterizers.reference import LARGEST_PROJECTION

HALF = np.float64(0.5)
LARGEST_FLOAT32 = np.float32(np.finfo(np.float32).max)
RADIX_BITS = 11
BUCKETS = 1 << RADIX_BITS
PASSES = 4
# Depths are sorted as integers of the same order: 8 bits of the exponent above that of the smallest normal float32, and
# the first 36 of the fraction. With a float32's 23, some neighbours in a large scene would be in the wrong order.
SMALLEST_DEPTH_BITS = np.float64(2.0**-126).view(np.int64)
DROPPED_BITS = 8 + 52 - PASSES * RADIX_BITS
# Columns of the sums over views, after which the chain rule continues for each Gaussian separately.
TOTAL_COLOR = 0
TOTAL_LOG_OPACITY = 3
TOTAL_MEAN = 4
TOTAL_ROOT = 7
TOTAL_REACHED = 16
TOTALS_WIDTH = 17
no_totals = simd.zeros(TOTALS_WIDTH)
gather_one = simd.gather(1)
gather_three = simd.gather(3)
gather_four = simd.gather(4)
one_column = simd.columns(1)
four_columns = simd.columns(4)


@kernel
def prepare(
    means: Array, quaternions: Array, scales: Array, opacities: Array, colors: Array, log2_min_alpha: float,
    prepared: Array,
) -> None:  # fmt: skip
    """Fill `prepared` and mark Gaussians that are too transparent to be seen or have values that are not finite."""
    count = means.shape[0]
    flat = prepared.reshape(-1)
    stride = prepared.shape[1]
    prepared[layout.REACH, count:] = -ONE
    for i in range(count):
        log2_opacity = math.log2(np.float64(opacities[i]))
        visible = log2_opacity >= log2_min_alpha and opacities[i] <= LARGEST_FLOAT32
        prepared[layout.LOG2_OPACITY_AND_COLOR, i] = log2_opacity
        prepared[layout.REACH, i] = log2_opacity - log2_min_alpha + layout.SLACK if visible else -ONE
    for start in range(0, count, simd.LANES):
        mean = gather_three(means.reshape(-1), 3, 0, start, count)
        quaternion, scale = lane_shapes(quaternions, scales, start, count)
        color = gather_three(colors.reshape(-1), 3, 0, start, count)
        w, x, y, z, _ = projection.unit_quaternion(simd.widen(quaternion))
        root = simd.narrow(scaled_columns(projection.rotation_matrix(w, x, y, z), simd.widen(scale)))
        simd.store_columns(flat, stride, layout.MEAN * stride + start, mean + root)
        simd.store_columns(flat, stride, (layout.LOG2_OPACITY_AND_COLOR + 1) * stride + start, color)
        finite = simd.all_within(mean + quaternion + scale + color, LARGEST_FLOAT32)
        place = layout.REACH * stride + start
        simd.store(flat, place, simd.choose(finite, simd.load(flat, place), -ONE))


@helper
def lane_shapes(quaternions, scales, start, end):
    """Return quaternions and scales of the Gaussians start, ..., start + 15, with end - 1 for any beyond that."""
    quaternion = gather_four(quaternions.reshape(-1), 4, 0, start, end)
    return quaternion, gather_three(scales.reshape(-1), 3, 0, start, end)


@helper
def scaled_columns(m, a):
    """Return M diag(a), row-major."""
    return (
        m[0] * a[0], m[1] * a[1], m[2] * a[2],
        m[3] * a[0], m[4] * a[1], m[5] * a[2],
        m[6] * a[0], m[7] * a[1], m[8] * a[2],
    )  # fmt: skip


@kernel
def project(
    prepared: Array, camera: Array, height: int, width: int, blur: float, near_plane: float,
    unsorted: Array, keys: Array, order: Array, records: Array,
) -> int:  # fmt: skip
    """Project, cull and sort the Gaussians of one scene for one camera.

    Args:
        unsorted: scratch [gaussian + 1, 16] float32.
        keys, order: scratch [2, gaussian + 1], int64 and int32.
        records: receives the visible Gaussians, front to back.

    Returns:
        The number of visible Gaussians.
    """
    count = 0
    rotation = projection.load_nine(camera, layout.ROTATION)
    flat = prepared.reshape(-1)
    stride = prepared.shape[1]
    unsorted_flat = unsorted.reshape(-1)
    depths = keys[0].view(np.float64)
    for start in range(0, stride, simd.LANES):
        mean, root = projection.lane_gaussians(prepared, start)
        (reach,) = simd.widen(one_column(flat, stride, layout.REACH * stride + start))
        x, y, z = projection.camera_point(camera, rotation, simd.widen(mean))
        inside = (reach > ZERO) & (z > near_plane) & (z <= LARGEST_FLOAT32)
        if not simd.any_lane(inside):
            continue
        inverse_z = ONE / z
        slope_x = x * inverse_z
        slope_y = y * inverse_z
        center_x = camera[layout.FOCAL_X] * slope_x + camera[layout.PRINCIPAL_X]
        center_y = camera[layout.FOCAL_Y] * slope_y + camera[layout.PRINCIPAL_Y]
        row_x, row_y = projection.image_jacobian(camera, rotation, slope_x, slope_y, inverse_z)
        wide = simd.widen(root)
        xx, xy, yy, determinant = projection.covariance_2d(
            projection.row_times_matrix(row_x, wide), projection.row_times_matrix(row_y, wide), blur
        )
        # sigma = ln(2) * reach is an ellipse with these half extents.
        extent_x = simd.square_root(TWO * LN2 * reach * xx)
        extent_y = simd.square_root(TWO * LN2 * reach * yy)
        top = max(center_y - extent_y + HALF, 0.0)
        bottom = min(center_y + extent_y - HALF, height - ONE)
        inside = inside & simd.all_within((center_x, center_y, xx, yy), LARGEST_PROJECTION) & (top < bottom + ONE)
        inside = inside & (center_x + extent_x >= HALF) & (center_x - extent_x <= width - HALF)
        inverse_yy = ONE / yy
        inverse_u = simd.square_root(TWO * LN2 * determinant * inverse_yy)
        # In the order of the records' columns.
        shape = simd.narrow((center_x, center_y, ONE / inverse_u, xy * inverse_yy, simd.square_root(reach) / extent_y))
        opacity_and_color = four_columns(flat, stride, layout.LOG2_OPACITY_AND_COLOR * stride + start)
        extents = simd.narrow((z, inverse_u, xy / xx * extent_x, extent_y))
        rest = (packed_blocks(top, bottom), index_bits(start), simd.splat(ZERO))
        count = append(inside, shape + opacity_and_color + extents + rest, unsorted_flat, z, depths, count)
    radix_sort(depths, keys, order, count)
    records_flat = records.reshape(-1)
    for j in range(count):
        source = np.int64(order[PASSES % 2, j]) * layout.RECORD_WIDTH
        simd.store(records_flat, j * layout.RECORD_WIDTH, simd.load(unsorted_flat, source))
    return count


@helper
def depth_key(z):
    """Return a depth's sort key, which has PASSES * RADIX_BITS bits."""
    bits = np.float64(z).view(np.int64) - SMALLEST_DEPTH_BITS
    return bits >> DROPPED_BITS if bits > 0 else 0


@helper
def radix_sort(depths, keys, order, count):
    """Sort depths[:count], which share the memory of keys[0], stably. The result is order[PASSES % 2]."""
    starts = np.zeros((PASSES, BUCKETS), np.int32)
    for i in range(count):
        order[0, i] = i
        keys[0, i] = depth_key(depths[i])
        for digit in range(PASSES):
            starts[digit, (keys[0, i] >> (RADIX_BITS * digit)) & (BUCKETS - 1)] += 1
    for digit in range(PASSES):
        total = 0
        for bucket in range(BUCKETS):
            size = starts[digit, bucket]
            starts[digit, bucket] = total
            total += size
        source = digit % 2
        target = 1 - digit % 2
        for i in range(count):
            key = keys[source, i]
            bucket = (key >> (RADIX_BITS * digit)) & (BUCKETS - 1)
            position = starts[digit, bucket]
            starts[digit, bucket] = position + 1
            keys[target, position] = key
            order[target, position] = order[source, i]


@simd.vector_function(simd.VECTOR)
def packed_blocks(builder, first, last):
    """Return, as the bits of int32, the block of each first pixel, and that of each last pixel shifted up."""
    block_shift = ir.Constant(simd.INTEGERS_IR, [layout.BLOCK_SHIFT] * simd.LANES)
    half_word = ir.Constant(simd.INTEGERS_IR, [16] * simd.LANES)
    low = builder.ashr(builder.fptosi(first, simd.INTEGERS_IR), block_shift)
    high = builder.ashr(builder.fptosi(last, simd.INTEGERS_IR), block_shift)
    return builder.bitcast(builder.or_(low, builder.shl(high, half_word)), simd.VECTOR_IR)


@simd.vector_function(simd.VECTOR)
def index_bits(builder, start):
    """Return start, ..., start + 15 as the bits of int32."""
    first = simd.in_every_lane(builder, builder.trunc(start, simd.I32))
    return builder.bitcast(builder.add(first, ir.Constant(simd.INTEGERS_IR, list(range(simd.LANES)))), simd.VECTOR_IR)


@simd.vector_function(types.int64)
def append(builder, mask, vectors, rows, vector, numbers, count):
    """Append lane i of 16 vectors as a row to a flat array, and lane i of `vector` to `numbers`, for i in the mask.

    Return the new number of rows. One row beyond them is overwritten.
    """
    for lane, row in enumerate(simd.transposed(builder, simd.unpack(builder, vectors))):
        place = ir.Constant(simd.I32, lane)
        first = builder.mul(count, ir.Constant(simd.I64, simd.LANES))
        builder.store(row, simd.address(builder, rows, first, simd.VECTOR_IR), align=4)
        builder.store(builder.extract_element(vector, place), builder.gep(numbers, [count], inbounds=True))
        count = builder.add(count, builder.zext(builder.extract_element(mask, place), simd.I64))
    return count


@kernel
def project_backward(
    quaternions: Array, scales: Array, opacities: Array, prepared: Array, cameras: Array, blur: float,
    gradients: Array, places: Array, first: int, end: int,
    grad_means: Array, grad_quaternions: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
) -> None:  # fmt: skip
    """Apply the chain rule through the projection to the Gaussians [first, end) of one scene, summed over views.

    Args:
        cameras: [view 20] float64.
        gradients, places: [view band row 16] and [view band lane], written by `composite`.
        first: a multiple of 16.
    """
    for start in range(first, end, simd.LANES):
        totals = sum_views(prepared, cameras, blur, gradients, places, start)
        reached = totals[TOTAL_REACHED] > ZERO
        quaternion, scale = lane_shapes(quaternions, scales, start, end)
        opacity = gather_one(opacities, 1, 0, start, end)
        grad_root = simd.widen(totals[TOTAL_ROOT:TOTAL_REACHED])
        grad_quaternion, grad_scale = root_backward(simd.widen(quaternion), simd.widen(scale), grad_root)
        (grad_log_opacity,) = simd.widen(totals[TOTAL_LOG_OPACITY:TOTAL_MEAN])
        grad_opacity = simd.narrow((grad_log_opacity / simd.widen(opacity)[0],))
        simd.scatter(grad_colors.reshape(-1), start, end, totals[TOTAL_COLOR:TOTAL_LOG_OPACITY])
        simd.scatter(grad_means.reshape(-1), start, end, totals[TOTAL_MEAN:TOTAL_ROOT])
        simd.scatter(grad_opacities, start, end, simd.keep_each(reached, grad_opacity))
        simd.scatter(grad_quaternions.reshape(-1), start, end, simd.keep_each(reached, simd.narrow(grad_quaternion)))
        simd.scatter(grad_scales.reshape(-1), start, end, simd.keep_each(reached, simd.narrow(grad_scale)))


@helper
def sum_views(prepared, cameras, blur, gradients, places, start):
    """Return the totals of the Gaussians start, ..., start + 15, in the order of the columns `TOTAL_...`."""
    mean, root = projection.lane_gaussians(prepared, start)
    totals = no_totals()
    for view in range(cameras.shape[0]):
        sums = projection.lane_sums_of_view(gradients[view], places[view], start)
        mask = sums[layout.REACHED] > ZERO
        if not simd.any_lane(mask):
            continue
        grad_mean, grad_root = projection.view_gradients(mean, root, cameras[view], blur, sums)
        color = (sums[layout.SUM_COLOR], sums[layout.SUM_COLOR + 1], sums[layout.SUM_COLOR + 2])
        log_opacity = (sums[layout.SUM_S],)
        parts = color + log_opacity + grad_mean + grad_root + (sums[layout.REACHED],)
        # Lanes that are not reached may hold any value, even NaN.
        totals = simd.add_each(totals, simd.keep_each(mask, parts))
    return totals


@helper
def root_backward(quaternion, scale, n):
    """Return the gradients of quaternion and scale from the gradient n of root = R(q / |q|) diag(scale)."""
    w, x, y, z, inverse_norm = projection.unit_quaternion(quaternion)
    rotation = projection.rotation_matrix(w, x, y, z)
    grad_scale = (
        rotation[0] * n[0] + rotation[3] * n[3] + rotation[6] * n[6],
        rotation[1] * n[1] + rotation[4] * n[4] + rotation[7] * n[7],
        rotation[2] * n[2] + rotation[5] * n[5] + rotation[8] * n[8],
    )
    g = scaled_columns(n, scale)
    grad_w = TWO * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    grad_x = TWO * (-TWO * x * (g[4] + g[8]) + y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]))
    grad_y = TWO * (x * (g[1] + g[3]) - TWO * y * (g[0] + g[8]) + z * (g[5] + g[7]) + w * (g[2] - g[6]))
    grad_z = TWO * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - TWO * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    # Normalisation removes the part along q (and everything for a zero quaternion, whose inverse norm is set to 0).
    along = grad_w * w + grad_x * x + grad_y * y + grad_z * z
    grad_quaternion = (
        (grad_w - along * w) * inverse_norm,
        (grad_x - along * x) * inverse_norm,
        (grad_y - along * y) * inverse_norm,
        (grad_z - along * z) * inverse_norm,
    )
    return grad_quaternion, grad_scale
