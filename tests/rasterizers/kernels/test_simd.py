"""The vector functions of the kernels against NumPy."""

import numpy as np
import pytest

from completesplat.rasterizers.kernels import composite, project, simd
from completesplat.rasterizers.kernels.compilation import kernel
from completesplat.rasterizers.kernels.simd import LANES

exp2 = simd.exp2
load = simd.load
store = simd.store
lowest_bit = simd.lowest_bit
word_mask = composite.word_mask


@kernel
def run_exp2(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(0, values.shape[0], LANES):
        store(out, i, exp2(load(values, i)))


@kernel
def run_mask(word: int, first: int, last: int) -> tuple[int, int]:
    mask = word_mask(word, first, last)
    return mask, lowest_bit(mask) if mask != 0 else -1


def test_exp2_is_accurate_to_the_last_bits() -> None:
    x = np.concatenate([np.linspace(-126, 127, 16000), np.linspace(-8.1, 0.5, 15984), np.arange(-16, 0)])
    out = np.full(x.size, np.nan, np.float32)
    x = x.astype(np.float32)
    run_exp2(x, out)
    assert np.abs(out / np.exp2(x.astype(np.float64)) - 1).max() < 3e-7
    assert (out[-16:] < 1).all()


@pytest.mark.parametrize(("first", "last"), [(0, 0), (0, 63), (5, 9), (60, 70), (64, 127), (63, 128), (130, 140)])
def test_word_masks_hold_the_bits_of_their_columns(first: int, last: int) -> None:
    for word in range(first // 64, last // 64 + 1):
        mask, lowest = run_mask(word, first, last)
        columns = [64 * word + bit for bit in range(64) if mask >> bit & 1]
        assert columns == [column for column in range(first, last + 1) if column // 64 == word]
        assert lowest == columns[0] - 64 * word


append = project.append
load_block = composite.load_block
store_block = composite.store_block
three_columns = simd.columns(3)
sixteen_columns = simd.columns(LANES)
narrow = simd.narrow
scatter = simd.scatter
square_root = simd.square_root
widen = simd.widen


@kernel
def run_doubles(values: np.ndarray, out: np.ndarray) -> None:
    (x,) = widen((load(values, 0),))
    (y,) = narrow((square_root(x * x + 1e-10) - x,))  # all of it is lost in float32
    store(out, 0, y)


@kernel
def run_append(values: np.ndarray, rows: np.ndarray, numbers: np.ndarray, count: int) -> int:
    vectors = sixteen_columns(values, LANES, 0)
    (number,) = widen((vectors[0],))
    return append(number > 0.0, vectors, rows, number, numbers, count)


@kernel
def run_scatter(values: np.ndarray, out: np.ndarray, start: int, last: int) -> None:
    scatter(out, start, last, three_columns(values, LANES, 0))


@kernel
def run_blocks(image: np.ndarray, out: np.ndarray, corner: int, width: int) -> None:
    store_block(out, corner, width, load_block(image, corner, width))


def test_doubles_have_the_precision_of_float64() -> None:
    x = np.linspace(1, 2, LANES, dtype=np.float32)
    out = np.zeros(LANES, np.float32)
    run_doubles(x, out)
    assert np.allclose(out, 0.5e-10 / x, rtol=1e-4, atol=0)


def test_appended_rows_are_those_of_the_mask_in_their_order() -> None:
    values = np.random.default_rng(0).normal(size=(LANES, LANES)).astype(np.float32)
    rows = np.zeros((LANES + 3, LANES), np.float32)
    numbers = np.zeros(LANES + 3)
    count = run_append(values.reshape(-1), rows.reshape(-1), numbers, 2)
    selected = values.T[values[0] > 0]
    assert count == 2 + len(selected)
    assert np.array_equal(rows[2:count], selected)
    assert np.array_equal(numbers[2:count], selected[:, 0])
    assert not rows[:2].any()


@pytest.mark.parametrize("last", [17, 31, 32])
def test_scattered_rows_end_with_the_last_one(last: int) -> None:
    values = np.arange(1, 3 * LANES + 1, dtype=np.float32).reshape(3, LANES)
    out = np.zeros((40, 3), np.float32)
    run_scatter(values.reshape(-1), out.reshape(-1), 16, last)
    assert np.array_equal(out[16:last], values.T[: last - 16])
    assert not out[:16].any()
    assert not out[last:].any()


def test_a_block_is_read_and_written_where_it_stands() -> None:
    image = np.arange(11 * 9, dtype=np.float32).reshape(9, 11)
    out = np.zeros((9, 11), np.float32)
    run_blocks(image.reshape(-1), out.reshape(-1), 3 * 11 + 5, 11)
    expected = np.zeros_like(image)
    expected[3:7, 5:9] = image[3:7, 5:9]
    assert np.array_equal(out, expected)
