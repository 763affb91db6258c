"""Front-to-back compositing of one view's Gaussians over a band of block rows.

Every Gaussian in turn visits the blocks that its ellipse touches and that are still open. The state of a block
(its pixels' transmittance and colour, say) is a few vectors that stay in the processor's cache.
"""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.blocks import (
    BIT,
    BLOCK,
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
from completesplat.rasterizers.kernels.simd import LANES, any_lane, lowest_bit, splat, store

Array = np.ndarray

STATE_VECTORS = 6  # transmittance, red, green, blue, depth, alpha


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
    begin(first_row, end_row, columns, height, width, state)
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
                    offset = ((row - first_row) * columns + column) * (STATE_VECTORS * LANES)
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
def begin(first_row, end_row, columns, height, width, state):
    for row in range(first_row, end_row):
        for column in range(columns):
            offset = ((row - first_row) * columns + column) * (STATE_VECTORS * LANES)
            open_pixels(row, column, height, width, state, offset)
            for vector in range(1, STATE_VECTORS):
                store(state, offset + vector * LANES, splat(ZERO))


@helper
def write_images(first_row, end_row, columns, state, color, depth, alpha):
    height, width = alpha.shape
    for y in range(first_row * BLOCK, min(end_row * BLOCK, height)):
        for x in range(width):
            block = (y // BLOCK - first_row) * columns + x // BLOCK
            pixel = block * (STATE_VECTORS * LANES) + (y % BLOCK) * BLOCK + x % BLOCK
            for channel in range(3):
                color[channel, y, x] = state[pixel + (1 + channel) * LANES]
            depth[y, x] = state[pixel + 4 * LANES]
            alpha[y, x] = state[pixel + 5 * LANES]
