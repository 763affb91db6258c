"""Front-to-back compositing of one view's Gaussians over a band of block rows, and its backward pass.

`open_words` [row word] uint64 has a bit for each block of the band, 64 blocks of a row in each word. It is set while
the block has a pixel that is not opaque.
"""

import numpy as np
from llvmlite import ir
from numba.core import types

from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels import simd
from completesplat.rasterizers.kernels.compilation import helper, kernel

Array = np.ndarray

# State of a block. Forward: transmittance, red, green, blue, depth, alpha. Backward: transmittance, sum behind, and
# gradients of red, green, blue, depth.
STATE_VECTORS = 6
reached_flag = simd.lane_constant([lane == layout.REACHED for lane in range(simd.LANES)])
BLOCK = layout.BLOCK
SLACK = np.float32(layout.SLACK)
WORD_BITS = 64
WORD_SHIFT = 6
ZERO = np.float32(0)
ONE = np.float32(1)
ALL_BITS = np.uint64(2**64 - 1)
BIT = np.uint64(1)
TWO_BITS = np.uint64(2)
# In px; extends the choice of blocks against rounding. The test at the pixel itself decides.
MARGIN = np.float32(0.01)

ROWS_AT_ONCE = simd.LANES // 2  # in `row_spans`

# Pixel centres relative to the block's corner.
lane_x = simd.lane_constant([lane % BLOCK + 0.5 for lane in range(simd.LANES)])
lane_y = simd.lane_constant([lane // BLOCK + 0.5 for lane in range(simd.LANES)])
# For the left ends of block rows, then for the right ends: top pixel row, direction, and limits of the pixel column.
row_tops = simd.lane_constant([lane % ROWS_AT_ONCE * BLOCK + 0.5 for lane in range(simd.LANES)])
side = simd.lane_constant([-1] * ROWS_AT_ONCE + [1] * ROWS_AT_ONCE)
is_left = simd.lane_constant([1] * ROWS_AT_ONCE + [0] * ROWS_AT_ONCE)
lowest_pixel = simd.lane_constant([0] * ROWS_AT_ONCE + [-BLOCK] * ROWS_AT_ONCE)


@kernel
def composite(
    records: Array, count: int, first_row: int, end_row: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    state: Array, open_words: Array, spans: Array,
    color: Array, depth: Array, alpha: Array,
    grad_color: Array | None, grad_depth: Array | None, grad_alpha: Array | None,
    gradients: Array | None, places: Array | None,
) -> None:  # fmt: skip
    """Draw the block rows first_row..end_row - 1 of one view, or sum every Gaussian's gradients over them.

    numba compiles two versions, each without the code that only the other needs.

    Args:
        records: [gaussian 16], of which the first `count` are used.
        state: scratch [block * 6 * 16], all blocks of the band.
        open_words: scratch [row word] uint64.
        spans: scratch [2 * row + 32] int32.
        color, depth, alpha: the whole images [3 height width], [height width] twice. The band is written or read.
        grad_color, grad_depth, grad_alpha: gradients of the loss with respect to these images; None to draw.
        gradients, places: [gaussian + 1 16] and [lane], see `array_layout`.
    """
    written = 0
    height, width = alpha.shape
    columns = (width + BLOCK - 1) // BLOCK
    integers = records.view(np.int32)
    begin(first_row, end_row, columns, height, width, state)
    if gradients is not None and places is not None:
        flat_gradients = gradients.reshape(-1)
        simd.store(flat_gradients, 0, simd.splat(ZERO))
        places[:] = 0
        read_images(first_row, end_row, columns, state, color, depth, alpha, grad_color, grad_depth, grad_alpha)
    blocks_left = open_all_blocks(open_words, end_row - first_row, columns)
    for j in range(count):
        rows = integers[j, layout.ROWS]
        top = max(rows & 0xFFFF, first_row)
        bottom = min(rows >> 16, end_row - 1)
        if bottom < top:
            continue
        if blocks_left == 0:
            break
        row_spans(records, j, log2_min_alpha, top, bottom, width, spans)
        red = records[j, layout.RED]
        green = records[j, layout.GREEN]
        blue = records[j, layout.BLUE]
        z = records[j, layout.DEPTH]
        reached = False
        zero = simd.splat(ZERO)
        sum_red = zero
        sum_green = zero
        sum_blue = zero
        sum_z = zero
        sum_s = zero
        sum_su = zero
        sum_sv = zero
        sum_suu = zero
        sum_suv = zero
        sum_svv = zero
        for row in range(top, bottom + 1):
            span = span_offset(row - top)
            first = spans[span]
            last = spans[span + ROWS_AT_ONCE]
            if last < first:
                continue
            for word in range(first >> WORD_SHIFT, (last >> WORD_SHIFT) + 1):
                mask = open_words[row - first_row, word] & word_mask(word, first, last)
                if mask == 0:
                    continue
                reached = True
                u_row, v, exponent_row = row_terms(records, j, row)
                while mask != 0:
                    column = (word << WORD_SHIFT) + simd.lowest_bit(mask)
                    mask &= mask - BIT
                    offset = ((row - first_row) * columns + column) * (STATE_VECTORS * simd.LANES)
                    u = u_row + column_offset(records, j, column)
                    value, opacity = alpha_at(exponent_row - u * u, log2_min_alpha, max_alpha)
                    transmittance = state_vector(state, offset, 0)
                    weight, behind, passes = attenuate(transmittance, opacity, min_transmittance)
                    simd.store(state, offset, behind)
                    if gradients is None:
                        simd.store(state, offset + simd.LANES, state_vector(state, offset, 1) + weight * red)
                        simd.store(state, offset + 2 * simd.LANES, state_vector(state, offset, 2) + weight * green)
                        simd.store(state, offset + 3 * simd.LANES, state_vector(state, offset, 3) + weight * blue)
                        simd.store(state, offset + 4 * simd.LANES, state_vector(state, offset, 4) + weight * z)
                        simd.store(state, offset + 5 * simd.LANES, state_vector(state, offset, 5) + weight)
                    else:
                        grad_red = state_vector(state, offset, 2)
                        grad_green = state_vector(state, offset, 3)
                        grad_blue = state_vector(state, offset, 4)
                        grad_z = state_vector(state, offset, 5)
                        grad_value = grad_red * red + grad_green * green + grad_blue * blue + grad_z * z
                        sum_behind = state_vector(state, offset, 1) - weight * grad_value
                        simd.store(state, offset + simd.LANES, sum_behind)
                        grad_opacity = transmittance * grad_value - sum_behind / (ONE - opacity)
                        # s = -dL/dsigma = alpha dL/dalpha; the clamp at max_alpha has no gradient.
                        s = simd.keep(passes & (value <= max_alpha), opacity * grad_opacity)
                        sum_red = sum_red + weight * grad_red
                        sum_green = sum_green + weight * grad_green
                        sum_blue = sum_blue + weight * grad_blue
                        sum_z = sum_z + weight * grad_z
                        su = s * u
                        sv = s * v
                        sum_s = sum_s + s
                        sum_su = sum_su + su
                        sum_sv = sum_sv + sv
                        sum_suu = sum_suu + su * u
                        sum_suv = sum_suv + su * v
                        sum_svv = sum_svv + sv * v
                    if not simd.any_lane(behind > ZERO):
                        close_block(open_words, row - first_row, column)
                        blocks_left -= 1
        written += reached
        if gradients is not None and places is not None and reached:
            moments = (sum_s, sum_su, sum_sv, sum_suu, sum_suv, sum_svv)
            sums = simd.lane_sums((sum_red, sum_green, sum_blue, sum_z) + moments)  # noqa: RUF005
            simd.store(flat_gradients, written * layout.GRADIENT_WIDTH, sums + reached_flag())
            places[integers[j, layout.INDEX]] = written
    if gradients is None:
        write_images(first_row, end_row, columns, state, color, depth, alpha)


@helper
def begin(first_row, end_row, columns, height, width, state):
    for row in range(first_row, end_row):
        for column in range(columns):
            offset = ((row - first_row) * columns + column) * (STATE_VECTORS * simd.LANES)
            open_pixels(row, column, height, width, state, offset)
            for vector in range(1, STATE_VECTORS):
                simd.store(state, offset + vector * simd.LANES, simd.splat(ZERO))


@helper
def write_images(first_row, end_row, columns, state, color, depth, alpha):
    height, width = alpha.shape
    plane = height * width
    flat_color = color.reshape(-1)
    flat_depth = depth.reshape(-1)
    flat_alpha = alpha.reshape(-1)
    for row in range(first_row, end_row):
        for column in range(columns):
            block = ((row - first_row) * columns + column) * (STATE_VECTORS * simd.LANES)
            corner = (row * width + column) * BLOCK
            if is_whole(row, column, height, width):
                for channel in range(3):
                    store_block(flat_color, channel * plane + corner, width, state_vector(state, block, 1 + channel))
                store_block(flat_depth, corner, width, state_vector(state, block, 4))
                store_block(flat_alpha, corner, width, state_vector(state, block, 5))
                continue
            for lane in range(simd.LANES):
                if is_inside(row, column, lane, height, width):
                    pixel = corner + lane // BLOCK * width + lane % BLOCK
                    for channel in range(3):
                        flat_color[channel * plane + pixel] = state[block + (1 + channel) * simd.LANES + lane]
                    flat_depth[pixel] = state[block + 4 * simd.LANES + lane]
                    flat_alpha[pixel] = state[block + 5 * simd.LANES + lane]


@helper
def read_images(first_row, end_row, columns, state, color, depth, alpha, grad_color, grad_depth, grad_alpha):
    """Write the gradients of the images, and the total sum, to the state."""
    height, width = alpha.shape
    plane = height * width
    flat_color = color.reshape(-1)
    flat_depth = depth.reshape(-1)
    flat_alpha = alpha.reshape(-1)
    colors = grad_color.reshape(-1)
    depths = grad_depth.reshape(-1)
    alphas = grad_alpha.reshape(-1)
    for row in range(first_row, end_row):
        for column in range(columns):
            block = ((row - first_row) * columns + column) * (STATE_VECTORS * simd.LANES)
            corner = (row * width + column) * BLOCK
            if is_whole(row, column, height, width):
                red = load_block(colors, corner, width)
                green = load_block(colors, plane + corner, width)
                blue = load_block(colors, 2 * plane + corner, width)
                z = load_block(depths, corner, width)
                total = red * load_block(flat_color, corner, width)
                total = total + green * load_block(flat_color, plane + corner, width)
                total = total + blue * load_block(flat_color, 2 * plane + corner, width)
                total = total + z * load_block(flat_depth, corner, width)
                through = ONE - load_block(flat_alpha, corner, width)
                simd.store(state, block + simd.LANES, total - load_block(alphas, corner, width) * through)
                simd.store(state, block + 2 * simd.LANES, red)
                simd.store(state, block + 3 * simd.LANES, green)
                simd.store(state, block + 4 * simd.LANES, blue)
                simd.store(state, block + 5 * simd.LANES, z)
                continue
            for lane in range(simd.LANES):
                if is_inside(row, column, lane, height, width):
                    pixel = corner + lane // BLOCK * width + lane % BLOCK
                    red = colors[pixel]
                    green = colors[plane + pixel]
                    blue = colors[2 * plane + pixel]
                    total = red * flat_color[pixel] + green * flat_color[plane + pixel]
                    total = total + blue * flat_color[2 * plane + pixel] + depths[pixel] * flat_depth[pixel]
                    state[block + simd.LANES + lane] = total - alphas[pixel] * (ONE - flat_alpha[pixel])
                    state[block + 2 * simd.LANES + lane] = red
                    state[block + 3 * simd.LANES + lane] = green
                    state[block + 4 * simd.LANES + lane] = blue
                    state[block + 5 * simd.LANES + lane] = depths[pixel]


@helper
def is_whole(row, column, height, width):
    """Return whether all pixels of a block are inside the image."""
    return (row + 1) * BLOCK <= height and (column + 1) * BLOCK <= width


@helper
def is_inside(row, column, lane, height, width):
    """Return whether this pixel of a block is inside the image."""
    return row * BLOCK + lane // BLOCK < height and column * BLOCK + lane % BLOCK < width


@helper
def open_all_blocks(open_words, rows, columns):
    """Set the bits of all blocks and return their number."""
    for row in range(rows):
        for word in range((columns + WORD_BITS - 1) >> WORD_SHIFT):
            open_words[row, word] = word_mask(word, 0, columns - 1)
    return rows * columns


@helper
def word_mask(word, first, last):
    """Return the bits of the block columns first..last (both included) in a word."""
    low = max(first - word * WORD_BITS, 0)
    high = min(last - word * WORD_BITS, WORD_BITS - 1)
    return ((TWO_BITS << np.uint64(high)) - BIT) & (ALL_BITS << np.uint64(low))


@helper
def close_block(open_words, row, column):
    open_words[row, column >> WORD_SHIFT] &= ~(BIT << np.uint64(column & (WORD_BITS - 1)))


@helper
def row_spans(records, j, log2_min_alpha, top, bottom, width, spans):
    """Find the first and last block column that the ellipse of record j touches in each of the block rows top..bottom.

    Write them to spans[offset] and spans[offset + ROWS_AT_ONCE], where offset is `span_offset(row - top)`.

    In a row at d_y the ellipse reaches from SHEAR d_y - h to SHEAR d_y + h with h^2 = (reach - (V d_y)^2) / U^2. Over
    the rows of a block the right end is largest as near as possible to RIGHTMOST_Y, the left end smallest as near as
    possible to -RIGHTMOST_Y. Left ends are in the first half of a vector's lanes, right ends in the second.
    """
    center_y = records[j, layout.CENTER_Y]
    extent = records[j, layout.EXTENT_Y]
    reach = records[j, layout.LOG2_OPACITY] - log2_min_alpha + SLACK
    # The left end has one pixel too much, so that truncation rounds it up. The limits keep the integers small.
    start = records[j, layout.CENTER_X] - side() * (np.float32(0.5) - MARGIN)
    extreme_y = side() * records[j, layout.RIGHTMOST_Y]
    stretch = side() * records[j, layout.INVERSE_U]
    lowest = lowest_pixel()
    highest = is_left() * np.float32(BLOCK + 1) + np.float32(width - 1)
    for row in range(top, bottom + 1, ROWS_AT_ONCE):
        low = row_tops() + (np.float32(row * BLOCK) - center_y)
        high = min(low + np.float32(BLOCK - 1), extent)
        y = min(max(extreme_y, max(low, -extent)), high)
        scaled = y * records[j, layout.V]
        half_width = simd.square_root(max(reach - scaled * scaled, ZERO))
        end = y * records[j, layout.SHEAR] + half_width * stretch + start
        store_blocks(spans, span_offset(row - top), min(max(end, lowest), highest))


@helper
def span_offset(row):
    """Return the offset in `spans` of the first block column of a row, counted from the top row."""
    return row + (row & ~(ROWS_AT_ONCE - 1))


@helper
def row_terms(records, j, row):
    """Return (u without its part from column and centre, v, exponent without u) in the lanes of block row `row`."""
    y = lane_y() + (np.float32(row * BLOCK) - records[j, layout.CENTER_Y])
    u = (lane_x() - y * records[j, layout.SHEAR]) * records[j, layout.U]
    v = y * records[j, layout.V]
    return u, v, records[j, layout.LOG2_OPACITY] - v * v


@helper
def column_offset(records, j, column):
    """Return the part of u from block column `column` and the centre."""
    return (np.float32(column * BLOCK) - records[j, layout.CENTER_X]) * records[j, layout.U]


@helper
def alpha_at(exponent, log2_min_alpha, max_alpha):
    """Return 2^exponent, and alpha: the same clamped from above, and zero below the threshold."""
    value = simd.exp2(exponent)
    return value, simd.keep(exponent >= log2_min_alpha, min(value, max_alpha))


@helper
def attenuate(transmittance, alpha, min_transmittance):
    """Return weight, transmittance behind (0 if a pixel stops), and a mask of the pixels that are contributed to."""
    weight = transmittance * alpha
    behind = transmittance - weight
    passes = behind > min_transmittance
    return simd.keep(passes, weight), simd.keep(passes, behind), passes


@helper
def open_pixels(row, column, height, width, state, offset):
    """Set a new block's transmittances: 1, but 0 for lanes outside the image, which must not keep the block open."""
    if is_whole(row, column, height, width):
        simd.store(state, offset, simd.splat(ONE))
        return
    for lane in range(simd.LANES):
        state[offset + lane] = ONE if is_inside(row, column, lane, height, width) else ZERO


@helper
def state_vector(state, offset, channel):
    return simd.load(state, offset + channel * simd.LANES)


@simd.vector_function(types.void)
def store_blocks(builder, array, offset, vector):
    """Store the block numbers of pixels, truncated to integers, in a flat int32 array."""
    places = ir.Constant(simd.INTEGERS_IR, [layout.BLOCK_SHIFT] * simd.LANES)
    blocks = builder.ashr(builder.fptosi(vector, simd.INTEGERS_IR), places)
    builder.store(blocks, simd.address(builder, array, offset, simd.INTEGERS_IR), align=4)


@simd.vector_function(simd.VECTOR)
def load_block(builder, array, corner, width):
    """Load 4 x 4 pixels, row-major, of a flat image of this width, from the one at `corner` on."""
    rows = [builder.load(row, align=4) for row in _block_rows(builder, array, corner, width)]
    return _joined(builder, _joined(builder, *rows[:2]), _joined(builder, *rows[2:]))


@simd.vector_function(types.void)
def store_block(builder, array, corner, width, vector):
    """Store 4 x 4 pixels as `load_block` reads them."""
    for y, row in enumerate(_block_rows(builder, array, corner, width)):
        lanes = ir.Constant(ir.VectorType(simd.I32, BLOCK), [y * BLOCK + x for x in range(BLOCK)])
        builder.store(builder.shuffle_vector(vector, vector, lanes), row, align=4)


def _block_rows(builder, array, corner, width):
    firsts = [builder.add(corner, builder.mul(width, ir.Constant(simd.I64, y))) for y in range(BLOCK)]
    return [simd.address(builder, array, first, ir.VectorType(simd.F32, BLOCK)) for first in firsts]


def _joined(builder, a, b):
    lanes = list(range(2 * a.type.count))
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(simd.I32, len(lanes)), lanes))
