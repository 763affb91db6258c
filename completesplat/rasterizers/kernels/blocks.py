"""Helpers shared by forward and backward compositing: which blocks a Gaussian touches, and its alpha there.

A band of block rows is worked on at once. `open_words` [row word] uint64 holds one bit for each block that has a
pixel that is not opaque yet, 64 blocks of a row to the word.
"""

import numpy as np

from completesplat.rasterizers.kernels import layout
from completesplat.rasterizers.kernels.compilation import helper
from completesplat.rasterizers.kernels.simd import (
    LANES,
    exp2,
    keep,
    lane_constant,
    load,
    splat,
    square_root,
    store,
    store_shifted,
)

BLOCK, BLOCK_SHIFT = layout.BLOCK, layout.BLOCK_SHIFT
SLACK = np.float32(layout.SLACK)
WORD_BITS = 64
WORD_SHIFT = 6
ZERO, ONE = np.float32(0), np.float32(1)
ALL_BITS = np.uint64(2**64 - 1)
BIT, TWO_BITS = np.uint64(1), np.uint64(2)
# Blocks are chosen a little generously, in px, against rounding. What counts is the test at the pixel itself.
MARGIN = np.float32(0.01)

ROWS_AT_ONCE = LANES // 2  # in `row_spans`

# Pixel centres relative to the block's corner.
lane_x = lane_constant([lane % BLOCK + 0.5 for lane in range(LANES)])
lane_y = lane_constant([lane // BLOCK + 0.5 for lane in range(LANES)])
# For the left ends of block rows, then for the right ends: top pixel row, direction, and limits of the pixel column.
row_tops = lane_constant([lane % ROWS_AT_ONCE * BLOCK + 0.5 for lane in range(LANES)])
side = lane_constant([-1] * ROWS_AT_ONCE + [1] * ROWS_AT_ONCE)
is_left = lane_constant([1] * ROWS_AT_ONCE + [0] * ROWS_AT_ONCE)
lowest_pixel = lane_constant([0] * ROWS_AT_ONCE + [-BLOCK] * ROWS_AT_ONCE)


@helper
def open_all_blocks(open_words, rows, columns):
    """Set the bits of all blocks; returns their number."""
    for row in range(rows):
        for word in range((columns + WORD_BITS - 1) >> WORD_SHIFT):
            open_words[row, word] = word_mask(word, 0, columns - 1)
    return rows * columns


@helper
def word_mask(word, first, last):
    """Bits of the block columns first..last (both included) in a word."""
    low = max(first - word * WORD_BITS, 0)
    high = min(last - word * WORD_BITS, WORD_BITS - 1)
    return ((TWO_BITS << np.uint64(high)) - BIT) & (ALL_BITS << np.uint64(low))


@helper
def close_block(open_words, row, column):
    open_words[row, column >> WORD_SHIFT] &= ~(BIT << np.uint64(column & (WORD_BITS - 1)))


@helper
def row_spans(records, j, log2_min_alpha, top, bottom, width, spans):
    """First and last block column that the ellipse of record j touches in each of the block rows top..bottom.

    They go to spans[offset] and spans[offset + ROWS_AT_ONCE], where offset is `span_offset(row - top)`.

    In a row at d_y the ellipse reaches from SHEAR d_y - h to SHEAR d_y + h with h^2 = (reach - (V d_y)^2) / U^2. Over
    the rows of a block the right end is largest as near as possible to RIGHTMOST_Y, the left end smallest near minus
    it. The left ends are in the first half of a vector's lanes, the right ends in the second.
    """
    center_y, extent = records[j, layout.CENTER_Y], records[j, layout.EXTENT_Y]
    reach = records[j, layout.LOG2_OPACITY] - log2_min_alpha + SLACK
    # Truncation of the left end, which has one pixel too much, rounds up. The limits keep the integers small.
    start = records[j, layout.CENTER_X] - side() * (np.float32(0.5) - MARGIN)
    extreme_y, stretch = side() * records[j, layout.RIGHTMOST_Y], side() * records[j, layout.INVERSE_U]
    lowest, highest = lowest_pixel(), is_left() * np.float32(BLOCK + 1) + np.float32(width - 1)
    for row in range(top, bottom + 1, ROWS_AT_ONCE):
        low = row_tops() + (np.float32(row * BLOCK) - center_y)
        high = min(low + np.float32(BLOCK - 1), extent)
        y = min(max(extreme_y, max(low, -extent)), high)
        scaled = y * records[j, layout.V]
        half_width = square_root(max(reach - scaled * scaled, ZERO))
        end = y * records[j, layout.SHEAR] + half_width * stretch + start
        store_shifted(spans, span_offset(row - top), min(max(end, lowest), highest), BLOCK_SHIFT)


@helper
def span_offset(row):
    """Where the first block column of a row stands in `spans`, counted from the top row."""
    return row + (row & ~(ROWS_AT_ONCE - 1))


@helper
def row_terms(records, j, row):
    """(u at lane positions of block column 0 less U * centre, v, exponent without u) for block row `row`."""
    y = lane_y() + (np.float32(row * BLOCK) - records[j, layout.CENTER_Y])
    u = (lane_x() - y * records[j, layout.SHEAR]) * records[j, layout.U]
    v = y * records[j, layout.V]
    return u, v, records[j, layout.LOG2_OPACITY] - v * v


@helper
def column_offset(records, j, column):
    """What is added to u in block column `column`."""
    return (np.float32(column * BLOCK) - records[j, layout.CENTER_X]) * records[j, layout.U]


@helper
def alpha_at(exponent, log2_min_alpha, max_alpha):
    """(2^exponent, alpha): the same clamped from above, and zero below the threshold."""
    value = exp2(exponent)
    return value, keep(exponent >= log2_min_alpha, min(value, max_alpha))


@helper
def attenuate(transmittance, alpha, min_transmittance):
    """(weight, transmittance behind, mask of the pixels that took part); a pixel that stops is left with 0."""
    weight = transmittance * alpha
    behind = transmittance - weight
    passes = behind > min_transmittance
    return keep(passes, weight), keep(passes, behind), passes


@helper
def open_pixels(row, column, height, width, state, offset):
    """Transmittances of a fresh block: 1, but 0 for the lanes outside the image, which must not keep it open."""
    if (row + 1) * BLOCK <= height and (column + 1) * BLOCK <= width:
        store(state, offset, splat(ONE))
        return
    for lane in range(LANES):
        inside = row * BLOCK + lane // BLOCK < height and column * BLOCK + lane % BLOCK < width
        state[offset + lane] = ONE if inside else ZERO


@helper
def state_vector(state, offset, channel):
    return load(state, offset + channel * LANES)
