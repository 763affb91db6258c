"""Stage 1's module: what it starts from."""

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from support import compose_config

from completesplat.errors import WeightsError
from completesplat.training.checkpoints import read_checkpoint


def module(*settings: str):
    config = compose_config("fit", "experiment=toy_var", "rasterizer=reference", *settings)
    return instantiate(config.model, _convert_="all")


def test_a_second_part_starts_from_the_weights_of_the_first(pipeline):
    checkpoint = pipeline.var / "checkpoints/last.ckpt"
    weights = read_checkpoint(checkpoint)["state_dict"]
    started = module(f"model.checkpoint={checkpoint}").state_dict()
    assert started.keys() == weights.keys()
    assert all(torch.equal(started[key], weights[key]) for key in weights)
    assert any(not torch.equal(value, weights[key]) for key, value in module().state_dict().items())


def test_weights_of_another_architecture_are_no_start(pipeline):
    checkpoint = pipeline.var / "checkpoints/last.ckpt"
    with pytest.raises(InstantiationException) as caught:
        module(f"model.checkpoint={checkpoint}", "ablation=m1")
    assert isinstance(caught.value.__cause__, WeightsError)
    assert "another architecture" in str(caught.value.__cause__)
