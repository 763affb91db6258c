"""What a training step of stage 2 shows to which network."""

import pytest
import torch
from support import tiny_generator

from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import SceneBatch, Views
from completesplat.training.latent_diffusion import LatentDiffusion

BATCH, SIZE = 2, 32


def scenes(visible: torch.Tensor) -> SceneBatch:
    cameras = Cameras(torch.eye(4).repeat(BATCH, 2, 1, 1), pinhole(60, SIZE).repeat(BATCH, 2, 1, 1), (SIZE, SIZE))
    images = torch.rand(BATCH, 2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    views = Views(images, cameras, torch.ones(BATCH, 2, 1, SIZE, SIZE))
    depth_range = torch.tensor([[0.5, 4.0]]).repeat(BATCH, 1)
    return SceneBatch(
        views[:, 0], views[:, 1:], depth_range, visible, torch.zeros(BATCH, dtype=torch.int64), ("a", "b")
    )


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_conditioning_sees_the_visible_part_and_the_encoder_everything(share: float, monkeypatch) -> None:
    visible = torch.ones(BATCH, 1, SIZE, SIZE)
    visible[..., round(share * SIZE) :] = 0
    batch = scenes(visible)
    module = LatentDiffusion(
        tiny_generator(), rasterizer=ReferenceRasterizer(), optimizer=torch.optim.SGD, schedule=lambda optimizer: None
    )
    monkeypatch.setattr(module, "log", lambda *_, **__: None)  # There is no trainer.
    seen = {}
    parts = {
        "conditioning": module.completesplat.conditioning,
        "encoder": module.completesplat.autoreconstructor.encoder,
    }
    for name, part in parts.items():
        part.register_forward_pre_hook(lambda _, inputs, name=name: seen.update({name: inputs[0].clone()}))
    module.training_step(batch, 0)
    assert torch.equal(seen["encoder"], batch.reference.images)
    hidden = round(share * SIZE)
    assert torch.equal(seen["conditioning"][..., :hidden], batch.reference.images[..., :hidden])
    assert (seen["conditioning"][..., hidden:] == 0).all()
