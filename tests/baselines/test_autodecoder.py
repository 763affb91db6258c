import io

import pytest
import torch

from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.baselines.autodecoder import AutoDecoder, optimize_codes
from completesplat.errors import CompleteSplatError
from completesplat.splatter_image import Parameterization


def decoder(rows: int = 4, skip_levels: tuple[int, ...] = ()) -> AutoDecoder:
    torch.manual_seed(0)
    reconstructor = Reconstructor(Parameterization(), [8, 8], 1, norm_groups=4, skip_levels=skip_levels)
    return AutoDecoder(reconstructor, image_size=8, rows=rows)


def codes_of(model: AutoDecoder, *keys: tuple[str, int]) -> torch.Tensor:
    return model.codes_of(tuple(name for name, _ in keys), torch.tensor([frame for _, frame in keys]))


def test_an_image_keeps_its_code_until_the_table_is_full():
    model = decoder()
    first = codes_of(model, ("a", 0), ("b", 0), ("a", 1))
    again = codes_of(model, ("a", 1), ("a", 0), ("c", 0), ("b", 0), ("a", 0))
    assert torch.equal(again[[1, 3, 0, 4]], first[[0, 1, 2, 0]])
    assert len({tuple(code.flatten().tolist()) for code in again}) == 4
    with pytest.raises(CompleteSplatError, match="all 4 codes are taken"):
        codes_of(model, ("d", 0))


def test_a_checkpoint_knows_which_code_is_whose():
    model = decoder()
    file = io.BytesIO()
    expected = codes_of(model, ("b", 3), ("a", 0), ("b", 1))
    torch.save(model.state_dict(), file)
    file.seek(0)
    other = decoder()
    torch.nn.init.zeros_(other.codes)
    codes_of(other, ("z", 0))
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(codes_of(other, ("a", 0), ("b", 1), ("b", 3)), expected[[1, 2, 0]])
    assert torch.equal(codes_of(other, ("new", 0))[0], other.codes[3])


def test_new_codes_are_small_and_decided_by_the_seed_and_optimized_to_the_minimum_of_a_loss():
    one, again, other = (decoder().new_codes(64, seed) for seed in (0, 0, 1))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert one.std().item() == pytest.approx(0.01, rel=0.1)
    target = torch.linspace(-1, 1, 16).reshape(1, 4, 2, 2)
    with torch.inference_mode():
        result = optimize_codes(torch.zeros(1, 4, 2, 2), lambda x: (x - target.clone()).square().sum(), 200, 0.05)
    torch.testing.assert_close(result, target, atol=0.01, rtol=0)


def test_skips_and_sizes_that_do_not_fit_are_refused():
    with pytest.raises(CompleteSplatError, match="skip_levels"):
        decoder(skip_levels=(0,))
    with pytest.raises(CompleteSplatError, match="multiple of 2"):
        AutoDecoder(decoder().reconstructor, image_size=9, rows=1)
