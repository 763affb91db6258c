"""The vector functions of the kernels against NumPy."""

import numpy as np
import pytest

from completesplat.rasterizers.kernels import composite, simd
from completesplat.rasterizers.kernels.compilation import kernel
from completesplat.rasterizers.kernels.simd import LANES

exp2, load, store, lowest_bit, word_mask = simd.exp2, simd.load, simd.store, simd.lowest_bit, composite.word_mask


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
    out, x = np.full(x.size, np.nan, np.float32), x.astype(np.float32)
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
