import copy
import re
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from scenes_for_training import prediction, views
from support import compose_config
from torch import nn
from torchmetrics.functional.image import lpips as torchmetrics_lpips
from vgg_weights import CONVOLUTIONS, digest

from completesplat.losses.lpips import URL, LearnedPerceptualSimilarity

SHAPE = (2, 3, 3, 32, 32)


@pytest.fixture(scope="module")
def term(vgg_file):
    before = torch.get_rng_state()
    made = LearnedPerceptualSimilarity(str(vgg_file))
    assert torch.equal(torch.get_rng_state(), before)  # it draws no random numbers
    return made


@pytest.fixture(scope="module")
def pair():
    generator = torch.Generator().manual_seed(1)
    return torch.rand(SHAPE, generator=generator), torch.rand(SHAPE, generator=generator)


def flat(pair: tuple[torch.Tensor, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    return pair[0].flatten(0, 1), pair[1].flatten(0, 1)


def test_lpips_is_torchmetrics_value(term, weights, pair, monkeypatch):
    def features(net: str, pretrained: bool = False) -> nn.Sequential:
        layers = {i: nn.Conv2d(*channels, 3, padding=1) for i, channels in CONVOLUTIONS.items()}
        layers |= {i: nn.MaxPool2d(2) for i in (4, 9, 16, 23, 30)}
        network = nn.Sequential(*(layers.get(i, nn.ReLU()) for i in range(31)))
        network.load_state_dict({key.removeprefix("features."): value for key, value in weights.items()})
        return network

    monkeypatch.setattr(torchmetrics_lpips, "_get_tv_model_features", features)
    one, other = flat(pair)
    theirs = torchmetrics_lpips._NoTrainLpips(net="vgg")(one, other, normalize=True).flatten()
    torch.testing.assert_close(term.distance(one, other), theirs, rtol=1e-4, atol=0)
    value = term(prediction(pair[0]), views(pair[1])).item()
    assert value == pytest.approx(theirs.mean().item(), rel=1e-4)
    assert value > 0.01
    assert term(prediction(pair[0]), views(pair[0])).item() == 0


def test_the_gradient_is_the_slope_of_the_distance(term, pair):
    """Along a random direction, against central differences in float64."""
    distance = copy.deepcopy(term.distance).double()
    one, other = (x[:1].double() for x in flat(pair))
    direction = torch.randn(one.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    images = one.clone().requires_grad_()
    distance(images, other).sum().backward()
    ahead, behind = (distance(one + sign * 1e-6 * direction, other).sum() for sign in (1, -1))
    assert (images.grad * direction).sum().item() == pytest.approx((ahead - behind).item() / 2e-6, rel=1e-3)


@pytest.mark.parametrize("factor", [1e-30])
def test_a_layer_without_activity_costs_nothing_and_leaves_the_gradient_finite(term, pair, factor):
    """The squares of the faint one's activations underflow to zero, while the activations do not."""
    distance = copy.deepcopy(term.distance)
    last = distance.features.features[28]
    last.weight.mul_(factor)
    last.bias.mul_(factor)
    images = pair[0].flatten(0, 1).requires_grad_()
    value = distance(images, pair[1].flatten(0, 1))
    value.sum().backward()
    assert images.grad.isfinite().all()
    distance.heads[4].zero_()
    torch.testing.assert_close(distance(*flat(pair)), value.detach(), rtol=1e-5, atol=0)


def test_autocast_and_half_precision_images_do_not_lower_the_precision(term, pair):
    one, other = (x.bfloat16() for x in pair)
    expected = term(prediction(one.float()), views(other.float()))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert term(prediction(one), views(other)) == expected


def test_stage_two_adds_lpips_to_stage_one_and_nothing_to_the_checkpoint(vgg_file):
    file = [f"loss.terms.lpips.term.vgg_weights={vgg_file}", "loss.terms.lpips.term.vgg_sha256=null"]
    configs = [compose_config("fit", "loss=stage1"), compose_config("fit", "loss=stage2", *file)]
    first, second = (instantiate(config.model, _convert_="all") for config in configs)
    weights = {name: entry["weight"] for name, entry in second.loss.terms.items()}
    assert weights == {name: entry["weight"] for name, entry in first.loss.terms.items()} | {"lpips": 0.01}
    assert (weights["mse"], weights["ssim"]) == (0.8, 0.2)
    assert set(second.state_dict()) == set(first.state_dict())
    assert len(list(second.parameters())) == len(list(first.parameters()))


def test_stage_two_takes_the_published_file_only(vgg_file):
    assert compose_config("fit", "loss=stage2").loss.terms.lpips.term.vgg_weights == URL
    config = compose_config("fit", "loss=stage2", f"loss.terms.lpips.term.vgg_weights={vgg_file}")
    # The file's name holds the first digits of its hash.
    assert Path(URL).stem == f"vgg16-{config.loss.terms.lpips.term.vgg_sha256[:8]}"
    with pytest.raises(Exception, match=re.escape(f"SHA-256 {digest(vgg_file)}")):
        instantiate(config.loss, _convert_="all")
