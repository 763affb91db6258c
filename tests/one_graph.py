"""Compile the networks of each stage as one graph, forward and backward; `test_one_graph.py` runs it without hooks."""

import sys
from collections.abc import Iterator

import torch
from hydra.utils import instantiate
from support import compose_config
from torch import Tensor, nn

from completesplat.training.steps import synthetic_batch

PARTS = {
    "toy": (
        "autoreconstructor=small",
        "conditioning=learned",
        "conditioning.channels=[8,16,32]",
        "denoiser=tiny",
        "regressor=tiny",
    ),
    "paper": (
        "autoreconstructor=stable_diffusion",
        "conditioning=stable_diffusion",
        "denoiser=stable_diffusion",
        "regressor=splatter_image",
    ),
}


def one_graph(name: str, network: nn.Module, *inputs: object) -> None:
    """Fail if torch.compile finds more than one graph; call the network and go backward."""
    torch.compiler.reset()
    compiled = torch.compile(network.train(), backend="aot_eager", fullgraph=True)
    torch.stack([tensor.mean() for tensor in tensors(compiled(*inputs)) if tensor.requires_grad]).sum().backward()
    print(name)


def tensors(value: object) -> Iterator[Tensor]:
    """Yield all tensors of a network's output."""
    if isinstance(value, Tensor):
        yield value
        return
    for part in value if isinstance(value, list | tuple) else getattr(value, "__dict__", {}).values():
        yield from tensors(part)


if __name__ == "__main__":
    size = sys.argv[1]
    batch = synthetic_batch(32, batch=2, targets=2)
    images, views = batch.reference.images, batch.all_views()
    choices = ("model=var", "posterior=views", "data=toy_objects", *PARTS[size])
    config = compose_config("fit", *choices)
    model = instantiate(config.autoreconstructor, pretrained=None)
    one_graph("autoreconstructor", model, images, views, batch.depth_range)
    posterior, features = model.encoder(images)
    one_graph("encoder", model.encoder, images)
    one_graph(
        "reconstructor", model.reconstructor, posterior.mean.detach(), [f.detach() for f in features], torch.ones(2)
    )
    one_graph("regressor", instantiate(config.regressor), images)
    conditioning = instantiate(config.conditioning, **({"pretrained": None} if size == "paper" else {}))
    denoiser = instantiate(config.denoiser)
    one_graph("denoiser", denoiser, posterior.mean.detach(), torch.zeros(2, dtype=torch.int64), conditioning(images))
