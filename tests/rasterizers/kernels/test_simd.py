"""The vector functions of the kernels against NumPy."""

from collections.abc import Callable

import numpy as np
import pytest

from completesplat.rasterizers.kernels import composite, simd
from completesplat.rasterizers.kernels.compilation import kernel
from completesplat.rasterizers.kernels.simd import LANES

exp2, keep, lane_sums, load, store = simd.exp2, simd.keep, simd.lane_sums, simd.load, simd.store
any_lane, lowest_bit, store_blocks = simd.any_lane, simd.lowest_bit, simd.store_blocks
gather, transposed_rows, word_mask = simd.gather(2), simd.transposed_rows, composite.word_mask
LIMIT = np.float32(0.25)


@kernel
def run_exp2(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(0, values.shape[0], LANES):
        store(out, i, exp2(load(values, i)))


@kernel
def run_lane_sums(values: np.ndarray, out: np.ndarray) -> None:
    a, b, c = load(values, 0), load(values, LANES), load(values, 2 * LANES)
    store(out, 0, lane_sums((a, b, c, a, b, c, a, b, c, a)))


@kernel
def run_selects(values: np.ndarray, out: np.ndarray) -> bool:
    a = load(values, 0)
    store(out, 0, min(a, LIMIT))
    store(out, LANES, max(a, LIMIT))
    store(out, 2 * LANES, keep((a > LIMIT) & (a <= np.float32(2)), a))
    store(out, 3 * LANES, -a)
    return any_lane(a > np.float32(100))


@kernel
def run_gather(values: np.ndarray, start: int, last: int, out: np.ndarray) -> None:
    columns, rows = gather(values, 3, 1, start, last), transposed_rows(values, 16, start, last)
    store(out, 0, columns[0])
    store(out, LANES, columns[1])
    for i in range(LANES):
        store(out, (2 + i) * LANES, rows[i])


@kernel
def run_store_blocks(values: np.ndarray, out: np.ndarray) -> None:
    store_blocks(out, 1, load(values, 0))


@kernel
def run_mask(word: int, first: int, last: int) -> tuple[int, int]:
    mask = word_mask(word, first, last)
    return mask, lowest_bit(mask) if mask != 0 else -1


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    return np.random.default_rng(0).standard_normal(3 * LANES).astype(np.float32)


def apply(function: Callable, values: np.ndarray, size: int) -> np.ndarray:
    out = np.full(size, np.nan, np.float32)
    function(values, out)
    return out


def test_exp2_is_accurate_to_the_last_bits() -> None:
    x = np.concatenate([np.linspace(-126, 127, 16000), np.linspace(-8.1, 0.5, 16000)]).astype(np.float32)
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(apply(run_exp2, x, x.size) / exact - 1).max() < 3e-7
    assert (apply(run_exp2, np.arange(-16, 0, dtype=np.float32), 16) < 1).all()


def test_lane_sums(values: np.ndarray) -> None:
    sums = values.reshape(3, LANES).sum(1, dtype=np.float64)
    expected = np.concatenate([sums, sums, sums, sums[:1], np.zeros(6)])
    assert np.allclose(apply(run_lane_sums, values, LANES), expected, atol=1e-5)


def test_selects_and_the_treatment_of_nan(values: np.ndarray) -> None:
    a = values[:LANES].copy()
    a[3], a[5], a[6] = np.nan, np.inf, -np.inf
    out = apply(run_selects, a, 4 * LANES).reshape(4, LANES)
    with np.errstate(invalid="ignore"):
        assert np.array_equal(out[0], np.where(a < LIMIT, a, LIMIT))
        assert np.array_equal(out[1], np.where(a > LIMIT, a, LIMIT))
        assert np.array_equal(out[2], np.where((a > LIMIT) & (a <= 2), a, 0))
        assert np.array_equal(out[3], -a, equal_nan=True)
    assert run_selects(a, np.empty(4 * LANES, np.float32))
    assert not run_selects(np.full(LANES, 100, np.float32), np.empty(4 * LANES, np.float32))


@pytest.mark.parametrize(("first", "last"), [(0, 0), (0, 63), (5, 9), (60, 70), (64, 127), (63, 128), (130, 140)])
def test_word_masks_hold_the_bits_of_their_columns(first: int, last: int) -> None:
    for word in range(first // 64, last // 64 + 1):
        mask, lowest = run_mask(word, first, last)
        columns = [64 * word + bit for bit in range(64) if mask >> bit & 1]
        assert columns == [column for column in range(first, last + 1) if column // 64 == word]
        assert lowest == columns[0] - 64 * word


@pytest.mark.parametrize(("start", "last"), [(0, 16), (2, 16), (3, 4), (0, 30)])
def test_gathered_columns_and_rows_repeat_the_last_row(start: int, last: int) -> None:
    table = np.arange(30 * 16, dtype=np.float32)
    out = np.empty((2 + LANES, LANES), np.float32)
    run_gather(table, start, last, out.reshape(-1))
    rows = np.minimum(start + np.arange(LANES), last - 1)
    assert np.array_equal(out[:2], table[: 3 * 160].reshape(-1, 3)[rows, 1:].T)
    assert np.array_equal(out[2:], table.reshape(-1, 16)[rows].T)


def test_pixels_become_the_numbers_of_their_blocks() -> None:
    values = np.linspace(-9.7, 40.2, LANES).astype(np.float32)
    out = np.full(LANES + 2, 77, np.int32)
    run_store_blocks(values, out)
    assert out.tolist() == [77, *(int(value) >> 2 for value in values), 77]
