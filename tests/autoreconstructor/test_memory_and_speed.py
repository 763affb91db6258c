"""Options that change memory or speed, and nothing else: of the autoreconstructor and of the regression baseline."""

from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config
from torch import Tensor, nn

from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.scene import SceneBatch
from completesplat.training.reconstruction import ReconstructionModule

MODELS = {"var": "autoreconstructor", "splatter_image": "regressor"}


def module(model: str, *settings: str) -> ReconstructionModule:
    torch.manual_seed(0)
    config = compose_config("fit", f"model={model}", "rasterizer=reference", *settings)
    made = instantiate(config.model, _convert_="all")
    for name, parameter in made.named_parameters():
        if ".skips." in name:  # zero at the start
            nn.init.normal_(parameter, std=0.1)
    return made


def pair(model: str, setting: str) -> tuple[ReconstructionModule, ReconstructionModule]:
    """A module without and with a setting, of the same weights under the same names."""
    plain = module(model)
    other = module(model, setting)
    other.load_state_dict(plain.state_dict())
    return plain, other


@pytest.fixture(scope="module")
def scenes(toy_root) -> SceneBatch:
    data = ToyObjectsDataModule(str(toy_root), image_size=32, batch_size=2)
    data.setup("fit")
    return next(iter(data.val_dataloader()))


def loss(module: ReconstructionModule, scenes: SceneBatch) -> Tensor:
    """Return a loss of every output; posterior noise, skip dropout and dropout are the same in each call."""
    torch.manual_seed(1)
    reconstruction = module(scenes)
    kl = 0.0 if reconstruction.posterior is None else reconstruction.posterior.kl().mean()
    return reconstruction.splatter_image.raw.square().mean() + 1e-3 * kl


def loss_and_saved_bytes(module: ReconstructionModule, scenes: SceneBatch) -> tuple[Tensor, int]:
    """And what the forward pass keeps for the backward pass, apart from the weights."""
    weights = {parameter.untyped_storage().data_ptr() for parameter in module.parameters()}
    kept: dict[int, Any] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            kept[storage.data_ptr()] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = loss(module, scenes)  # alive, so that no storage's address is given away a second time
    return result, sum(storage.nbytes() for storage in kept.values())


@pytest.mark.parametrize("model", MODELS)
def test_gradient_checkpointing_keeps_less_and_leaves_loss_and_gradients_as_they_are(scenes, model):
    modules = pair(model, f"{MODELS[model]}.gradient_checkpointing=true")
    losses, sizes = zip(*(loss_and_saved_bytes(module.train(), scenes) for module in modules), strict=True)
    assert sizes[1] < sizes[0] / 2
    for value in losses:
        value.backward()
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-6, atol=0)
    plain, other = (dict(module.named_parameters()) for module in modules)
    for name, parameter in plain.items():
        torch.testing.assert_close(other[name].grad, parameter.grad, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("model", MODELS)
def test_channels_last_holds_for_weights_and_images_and_changes_no_output(scenes, model):
    plain, other = pair(model, "model.channels_last=true")
    seen: list[Tensor] = []
    for module in (plain, other):
        first = next(m for m in module.model.modules() if isinstance(m, nn.Conv2d) and m.in_channels == 3)
        first.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    one, two = (module.eval()(scenes).splatter_image.raw for module in (plain, other))
    torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-3)
    assert [tensor.is_contiguous(memory_format=torch.channels_last) for tensor in seen] == [False, True]
    kernels = [p.is_contiguous(memory_format=torch.channels_last) for p in other.parameters() if p.dim() == 4]
    assert kernels
    assert all(kernels)


@pytest.mark.parametrize("model", MODELS)
def test_a_compiled_model_has_the_same_keys_and_runs_what_the_compiler_returns(scenes, monkeypatch, model):
    calls = []
    monkeypatch.setattr(torch, "compile", lambda call, **_: lambda images: calls.append(images) or call(images))
    plain, compiled = pair(model, "model.compile=true")
    one = loss(plain, scenes)
    assert len(calls) == 0
    torch.testing.assert_close(loss(compiled, scenes), one)
    assert len(calls) == 1
