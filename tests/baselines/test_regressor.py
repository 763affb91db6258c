"""The regression baseline: its sizes, its first prediction, and that it trains like any stage 1."""

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config

from completesplat.baselines.regressor import SplatterImageUNet
from completesplat.baselines.splatter_image.network import SongUNet
from completesplat.splatter_image import Parameterization


def build(layers: int = 1) -> SplatterImageUNet:
    torch.manual_seed(0)
    shape = {"channels": (8, 16, 24), "attention_levels": (2,), "layers_per_block": 1, "norm_groups": 4}
    return SplatterImageUNet(Parameterization(layers=layers), **shape)


@pytest.fixture(scope="module")
def images():
    return torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def test_there_is_one_gaussian_to_a_layer_and_pixel_and_no_posterior_and_images_are_centred_on_grey(images):
    model = build(layers=2).eval()
    seen = []
    model.network.conv_in.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    reconstruction = model(images)
    assert reconstruction.posterior is None
    assert reconstruction.splatter_image.raw.shape == (2, 2, 15, 32, 32)
    torch.testing.assert_close(seen[0], 2 * images - 1)


@pytest.mark.parametrize("mixed", [False, True])
def test_gradients_reach_every_parameter_and_bfloat16_autocast_gives_finite_float32(images, mixed):
    model = build()
    inner = []
    model.network.conv_out.register_forward_hook(lambda *call: inner.append(call[2].dtype))
    with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
        raw = model(images).splatter_image.raw
    raw.square().mean().backward()
    assert inner == [torch.bfloat16 if mixed else torch.float32]
    assert raw.dtype == torch.float32
    assert raw.isfinite().all()
    assert all(p.grad.isfinite().all() for p in model.parameters())
    without = {name for name, p in model.named_parameters() if not p.grad.any()}
    assert all(name.endswith("to_k.bias") for name in without)  # added to all keys, it leaves the softmax as it is


def attention(width: int) -> int:
    return 2 * width + 4 * (width**2 + width)


def test_the_full_size_is_upstreams_but_for_the_differences_it_states():
    config = compose_config("fit", "regressor=splatter_image")
    with torch.device("meta"):
        model = instantiate(config.regressor, _convert_="all")
        defaults = SplatterImageUNet(Parameterization(layers=1))
        upstream = SongUNet(128, 3, 15, width=128, blocks=4, attention=[16])
    count, same, upstreams = (sum(p.numel() for p in net.parameters()) for net in (model, defaults, upstream))
    assert count == same
    time = sum(p.numel() for name, p in model.named_parameters() if "time_emb" in name)
    shortcuts = sum(width * width + width for width in (128, 256, 256, 256, 256, 256))
    assert count == upstreams + time + 4 * attention(256) - shortcuts


@pytest.mark.parametrize("ablation", ["m1", "skips_first_two"])
def test_it_composes_with_ablations(ablation):
    settings = ["experiment=toy_var", "model=splatter_image", "rasterizer=reference", f"ablation={ablation}"]
    module = instantiate(compose_config("fit", *settings).model, _convert_="all")
    assert isinstance(module.model, SplatterImageUNet)
    assert module.model.parameterization.layers == 1
