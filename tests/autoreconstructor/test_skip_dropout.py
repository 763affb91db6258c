"""Skip dropout (supplement, "Skip connection"): whole samples, all skips at once, at the stated rate."""

import pytest
import torch

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.splatter_image import Parameterization

SHAPE = {"channels": (8, 16), "layers_per_block": 1, "norm_groups": 4}
SAMPLES = 400


def build(skip_dropout: float) -> VariationalAutoReconstructor:
    """A model whose skips matter and whose latent is no draw: nothing but the skips can differ between samples."""
    torch.manual_seed(0)
    reconstructor = Reconstructor(Parameterization(), **SHAPE, skip_levels=(0, 1))
    model = VariationalAutoReconstructor(Encoder(**SHAPE), reconstructor, skip_dropout, variational=False)
    for conv in reconstructor.skips.values():
        torch.nn.init.normal_(conv.weight, std=0.5)
    return model.train()


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.5, 1.0])
@torch.no_grad()
def test_each_sample_has_all_its_skips_or_none(rate):
    model = build(rate)
    image = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    posterior, features = model.encoder(image)
    whole, none = (model.reconstructor(posterior.mode(), features, weight).raw for weight in (1.0, 0.0))
    assert (whole - none).abs().max() > 0.1
    torch.manual_seed(2)
    raw = model(image.repeat(SAMPLES, 1, 1, 1)).splatter_image.raw
    dropped, kept = ((raw - other).abs().amax((1, 2, 3, 4)) < 1e-4 for other in (none, whole))
    assert (dropped ^ kept).all()
    five_deviations = 5 * (rate * (1 - rate) / SAMPLES) ** 0.5
    assert abs(dropped.float().mean().item() - rate) <= five_deviations
    torch.testing.assert_close(model.eval()(image).splatter_image.raw, whole)  # evaluation drops none
