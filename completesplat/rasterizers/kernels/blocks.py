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
    maximum,
    minimum,
    splat,
    square_root,
    store,
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

# Pixel centres relative to the block's corner; top pixel row of 16 block rows relative to the first.
lane_x = lane_constant([lane % BLOCK + 0.5 for lane in range(LANES)])
lane_y = lane_constant([lane // BLOCK + 0.5 for lane in range(LANES)])
row_tops = lane_constant([lane * BLOCK + 0.5 for lane in range(LANES)])


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
    """Pixel columns that the ellipse of record j touches in the block rows top..bottom, to spans[:, row - top].

    In a row at d_y it reaches from SHEAR d_y - h to SHEAR d_y + h with h^2 = (reach - (V d_y)^2) / U^2. Over the
    rows of a block the right end is largest as near as possible to RIGHTMOST_Y, the left end smallest near minus it.
    """
    center_x, center_y = records[j, layout.CENTER_X], records[j, layout.CENTER_Y]
    shear, v, inverse_u = records[j, layout.SHEAR], records[j, layout.V], records[j, layout.INVERSE_U]
    rightmost, extent = records[j, layout.RIGHTMOST_Y], records[j, layout.EXTENT_Y]
    reach = records[j, layout.LOG2_OPACITY] - log2_min_alpha + SLACK
    limit = np.float32(width)
    for row in range(top, bottom + 1, LANES):
        low = row_tops() + (np.float32(row * BLOCK) - center_y)
        high = minimum(low + np.float32(BLOCK - 1), extent)
        low = maximum(low, -extent)
        right_y = minimum(maximum(splat(rightmost), low), high)
        left_y = minimum(maximum(splat(-rightmost), low), high)
        right = right_y * shear + half_width(right_y, v, reach) * inverse_u + (center_x - np.float32(0.5) + MARGIN)
        left = left_y * shear - half_width(left_y, v, reach) * inverse_u + (center_x + np.float32(0.5) - MARGIN)
        # Truncation of the left end, which has one pixel too much, rounds up. The clamps keep the integers small.
        store(spans, row - top, minimum(maximum(left, ZERO), limit + np.float32(BLOCK)))
        store(spans, spans.shape[0] // 2 + row - top, maximum(minimum(right, limit - ONE), np.float32(-BLOCK)))


@helper
def half_width(y, v, reach):
    scaled = y * v
    return square_root(maximum(reach - scaled * scaled, ZERO))


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
    return value, keep(exponent >= log2_min_alpha, minimum(value, max_alpha))


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
