"""Front-to-back compositing of one view's Gaussians over a band of block rows, and its backward pass."""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.blocks import (
    BIT,
    BLOCK,
    ONE,
    ROWS_AT_ONCE,
    WORD_SHIFT,
    ZERO,
    alpha_at,
    attenuate,
    close_block,
    column_offset,
    open_all_blocks,
    open_pixels,
    row_spans,
    row_terms,
    span_offset,
    state_vector,
    word_mask,
)
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.rasterizers.kernels.simd import (
    LANES,
    any_lane,
    keep,
    lane_constant,
    lane_sums,
    lowest_bit,
    splat,
    store,
)

Array = np.ndarray

FORWARD_STATE_VECTORS = 6  # transmittance, red, green, blue, depth, alpha
BACKWARD_STATE_VECTORS = 6  # transmittance, sum behind, gradients of red, green, blue, depth
reached_flag = lane_constant([lane == layout.REACHED for lane in range(LANES)])


@kernel
def composite(
    records: Array, count: int, first_row: int, end_row: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    state: Array, open_words: Array, spans: Array,
    color: Array, depth: Array, alpha: Array,
) -> None:  # fmt: skip
    """Draw the block rows first_row..end_row - 1 of one view.

    Args:
        records: [gaussian 16], of which the first `count` are used.
        state: scratch [block * 6 * 16], all blocks of the band.
        open_words: scratch [row word] uint64.
        spans: scratch [2 * row + 32] int32.
        color, depth, alpha: the whole images [3 height width], [height width] twice; the band is written.
    """
    height, width = alpha.shape
    columns = (width + BLOCK - 1) // BLOCK
    integers = records.view(np.int32)
    begin_forward(first_row, end_row, columns, height, width, state)
    blocks_left = open_all_blocks(open_words, end_row - first_row, columns)
    for j in range(count):
        rows = integers[j, layout.ROWS]
        top, bottom = max(rows & 0xFFFF, first_row), min(rows >> 16, end_row - 1)
        if bottom < top:
            continue
        row_spans(records, j, log2_min_alpha, top, bottom, width, spans)
        red, green, blue = records[j, layout.RED], records[j, layout.GREEN], records[j, layout.BLUE]
        z = records[j, layout.DEPTH]
        for row in range(top, bottom + 1):
            span = span_offset(row - top)
            first, last = spans[span], spans[span + ROWS_AT_ONCE]
            if last < first:
                continue
            for word in range(first >> WORD_SHIFT, (last >> WORD_SHIFT) + 1):
                mask = open_words[row - first_row, word] & word_mask(word, first, last)
                if mask == 0:
                    continue
                u_row, _, exponent_row = row_terms(records, j, row)
                while mask != 0:
                    column = (word << WORD_SHIFT) + lowest_bit(mask)
                    mask &= mask - BIT
                    offset = ((row - first_row) * columns + column) * (FORWARD_STATE_VECTORS * LANES)
                    u = u_row + column_offset(records, j, column)
                    _, opacity = alpha_at(exponent_row - u * u, log2_min_alpha, max_alpha)
                    weight, behind, _ = attenuate(state_vector(state, offset, 0), opacity, min_transmittance)
                    store(state, offset, behind)
                    store(state, offset + LANES, state_vector(state, offset, 1) + weight * red)
                    store(state, offset + 2 * LANES, state_vector(state, offset, 2) + weight * green)
                    store(state, offset + 3 * LANES, state_vector(state, offset, 3) + weight * blue)
                    store(state, offset + 4 * LANES, state_vector(state, offset, 4) + weight * z)
                    store(state, offset + 5 * LANES, state_vector(state, offset, 5) + weight)
                    if not any_lane(behind > ZERO):
                        close_block(open_words, row - first_row, column)
                        blocks_left -= 1
        if blocks_left == 0:
            break
    write_images(first_row, end_row, columns, state, color, depth, alpha)


@helper
def begin_forward(first_row, end_row, columns, height, width, state):
    for row in range(first_row, end_row):
        for column in range(columns):
            offset = ((row - first_row) * columns + column) * (FORWARD_STATE_VECTORS * LANES)
            open_pixels(row, column, height, width, state, offset)
            for vector in range(1, FORWARD_STATE_VECTORS):
                store(state, offset + vector * LANES, splat(ZERO))


@helper
def write_images(first_row, end_row, columns, state, color, depth, alpha):
    height, width = alpha.shape
    for y in range(first_row * BLOCK, min(end_row * BLOCK, height)):
        for x in range(width):
            block = (y // BLOCK - first_row) * columns + x // BLOCK
            pixel = block * (FORWARD_STATE_VECTORS * LANES) + (y % BLOCK) * BLOCK + x % BLOCK
            for channel in range(3):
                color[channel, y, x] = state[pixel + (1 + channel) * LANES]
            depth[y, x] = state[pixel + 4 * LANES]
            alpha[y, x] = state[pixel + 5 * LANES]


@kernel
def composite_backward(
    records: Array, count: int, first_row: int, end_row: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    state: Array, open_words: Array, spans: Array,
    color: Array, depth: Array, alpha: Array, grad_color: Array, grad_depth: Array, grad_alpha: Array,
    gradients: Array,
) -> None:  # fmt: skip
    """Add up, for every visible Gaussian, its gradients over the block rows first_row..end_row - 1 of one view.

    Args:
        state: scratch [block * 6 * 16]; otherwise as for `composite`, with the images that it drew.
        grad_color, grad_depth, grad_alpha: gradients of the loss with respect to these images.
        gradients: [gaussian 16], see `layout`; rows of Gaussians that are not visible are not written.
    """
    height, width = alpha.shape
    columns = (width + BLOCK - 1) // BLOCK
    integers = records.view(np.int32)
    flat_gradients = gradients.reshape(-1)
    begin_backward(first_row, end_row, columns, height, width, state)
    read_images(first_row, end_row, columns, state, color, depth, alpha, grad_color, grad_depth, grad_alpha)
    blocks_left = open_all_blocks(open_words, end_row - first_row, columns)
    for j in range(count):
        rows = integers[j, layout.ROWS]
        top, bottom = max(rows & 0xFFFF, first_row), min(rows >> 16, end_row - 1)
        index = np.int64(integers[j, layout.INDEX])
        if bottom < top or blocks_left == 0:
            gradients[index, layout.REACHED] = ZERO
            continue
        row_spans(records, j, log2_min_alpha, top, bottom, width, spans)
        red, green, blue = records[j, layout.RED], records[j, layout.GREEN], records[j, layout.BLUE]
        z = records[j, layout.DEPTH]
        reached = False
        zero = splat(ZERO)
        sum_red, sum_green, sum_blue, sum_z = zero, zero, zero, zero
        sum_s, sum_su, sum_sv, sum_suu, sum_suv, sum_svv = zero, zero, zero, zero, zero, zero
        for row in range(top, bottom + 1):
            span = span_offset(row - top)
            first, last = spans[span], spans[span + ROWS_AT_ONCE]
            if last < first:
                continue
            for word in range(first >> WORD_SHIFT, (last >> WORD_SHIFT) + 1):
                mask = open_words[row - first_row, word] & word_mask(word, first, last)
                if mask == 0:
                    continue
                reached = True
                u_row, v, exponent_row = row_terms(records, j, row)
                while mask != 0:
                    column = (word << WORD_SHIFT) + lowest_bit(mask)
                    mask &= mask - BIT
                    offset = ((row - first_row) * columns + column) * (BACKWARD_STATE_VECTORS * LANES)
                    u = u_row + column_offset(records, j, column)
                    value, opacity = alpha_at(exponent_row - u * u, log2_min_alpha, max_alpha)
                    transmittance = state_vector(state, offset, 0)
                    weight, behind, passes = attenuate(transmittance, opacity, min_transmittance)
                    store(state, offset, behind)

                    grad_red, grad_green = state_vector(state, offset, 2), state_vector(state, offset, 3)
                    grad_blue, grad_z = state_vector(state, offset, 4), state_vector(state, offset, 5)
                    own = grad_red * red + grad_green * green + grad_blue * blue + grad_z * z
                    sum_behind = state_vector(state, offset, 1) - weight * own
                    store(state, offset + LANES, sum_behind)
                    grad_opacity = transmittance * own - sum_behind / (ONE - opacity)
                    # s = -dL/dsigma = alpha dL/dalpha; the clamp at max_alpha lets nothing through.
                    s = keep(passes & (value <= max_alpha), opacity * grad_opacity)

                    sum_red = sum_red + weight * grad_red
                    sum_green = sum_green + weight * grad_green
                    sum_blue = sum_blue + weight * grad_blue
                    sum_z = sum_z + weight * grad_z
                    su, sv = s * u, s * v
                    sum_s, sum_su, sum_sv = sum_s + s, sum_su + su, sum_sv + sv
                    sum_suu, sum_suv, sum_svv = sum_suu + su * u, sum_suv + su * v, sum_svv + sv * v
                    if not any_lane(behind > ZERO):
                        close_block(open_words, row - first_row, column)
                        blocks_left -= 1
        if reached:
            sums = lane_sums((sum_red, sum_green, sum_blue, sum_z, sum_s, sum_su, sum_sv, sum_suu, sum_suv, sum_svv))
            store(flat_gradients, index * layout.GRADIENT_WIDTH, sums + reached_flag())
        else:
            gradients[index, layout.REACHED] = ZERO


@helper
def begin_backward(first_row, end_row, columns, height, width, state):
    for row in range(first_row, end_row):
        for column in range(columns):
            offset = ((row - first_row) * columns + column) * (BACKWARD_STATE_VECTORS * LANES)
            open_pixels(row, column, height, width, state, offset)
            if (row + 1) * BLOCK > height or (column + 1) * BLOCK > width:
                for vector in range(1, BACKWARD_STATE_VECTORS):
                    store(state, offset + vector * LANES, splat(ZERO))


@helper
def read_images(first_row, end_row, columns, state, color, depth, alpha, grad_color, grad_depth, grad_alpha):
    """Put the gradients of the images, and the total sum, into the state."""
    height, width = alpha.shape
    for y in range(first_row * BLOCK, min(end_row * BLOCK, height)):
        for x in range(width):
            block = (y // BLOCK - first_row) * columns + x // BLOCK
            pixel = block * (BACKWARD_STATE_VECTORS * LANES) + (y % BLOCK) * BLOCK + x % BLOCK
            red, green, blue = grad_color[0, y, x], grad_color[1, y, x], grad_color[2, y, x]
            state[pixel + 2 * LANES], state[pixel + 3 * LANES], state[pixel + 4 * LANES] = red, green, blue
            state[pixel + 5 * LANES] = grad_depth[y, x]
            total = red * color[0, y, x] + green * color[1, y, x] + blue * color[2, y, x]
            state[pixel + LANES] = total + grad_depth[y, x] * depth[y, x] - grad_alpha[y, x] * (ONE - alpha[y, x])
