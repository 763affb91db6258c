import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.plugins import Precision
from scenes_for_training import quiet_trainer, scene_batch
from support import NETWORKS, compose_config
from torch.utils.data import DataLoader

from completesplat.evaluation.naive_predictors import copy_reference, mirror_reference, repeat_image
from completesplat.training.callbacks import BadSteps
from completesplat.weights.checkpoint_reading import read_checkpoint


def module(*settings: str):
    config = compose_config("fit", "experiment=toy_var", "rasterizer=reference", *NETWORKS, *settings)
    return instantiate(config.model, _convert_="all")


def test_a_second_part_starts_from_the_weights_of_the_first(pipeline):
    checkpoint = pipeline.var / "checkpoints/last.ckpt"
    weights = read_checkpoint(checkpoint)["state_dict"]
    started = module(f"model.checkpoint={checkpoint}").state_dict()
    assert started.keys() == weights.keys()
    assert all(torch.equal(started[key], weights[key]) for key in weights)
    assert any(not torch.equal(value, weights[key]) for key, value in module().state_dict().items())


@pytest.mark.parametrize("masked", [False, True])
def test_hidden_pixels_are_not_seen_but_compared(masked, monkeypatch):
    scenes = scene_batch()
    scenes.visible[..., 4:12, 2:9] = 0
    trained = module(f"model.masked={str(masked).lower()}")
    monkeypatch.setattr(trained, "log", lambda *_, **__: None)  # There is no trainer.
    monkeypatch.setattr(type(trained), "global_step", 0)
    seen = []
    compared = []
    trained.model.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    loss = trained.loss
    trained.loss = lambda prediction, views, step: compared.append(views.images) or loss(prediction, views, step)
    trained.training_step(scenes, 0)
    images = scenes.reference.images
    assert torch.equal(seen[0], images * scenes.visible if masked else images)
    assert torch.equal(compared[0], scenes.all_views().images)
    assert (compared[0][:, 0][..., 4:12, 2:9] > 0).any()


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("guards", [[], [BadSteps()]])
def test_gradients_are_clipped_for_fused_optimizers_by_a_norm_that_is_computed_once(precision, guards, monkeypatch):
    if guards:
        monkeypatch.setattr(Precision, "clip_gradients", lambda *_: pytest.fail("computes the norm again"))
    trained = module("optimizer=adam", "optimizer._target_=torch.optim.SGD", "optimizer.lr=1", "schedule=constant")
    before = [p.detach().clone() for p in trained.parameters()]
    trainer = quiet_trainer(max_steps=1, precision=precision, gradient_clip_val=1e-3, callbacks=guards)
    trainer.fit(trained, DataLoader([scene_batch()], batch_size=None))
    moved = torch.cat([(p - b).flatten() for p, b in zip(trained.parameters(), before, strict=True)])
    assert trainer.optimizers[0].defaults["fused"]
    assert moved.norm().item() == pytest.approx(1e-3, rel=1e-2)  # as far as gradients of this norm go


def test_naive_predictions_are_the_reference_its_mirror_image_and_one_image():
    scenes = scene_batch()
    image = torch.rand(3, 16, 16)
    truth = scenes.all_views().images
    copied = copy_reference(scenes)
    repeated = repeat_image(image, scenes)
    assert copied.shape == repeated.shape == truth.shape
    assert all(torch.equal(copied[:, view], truth[:, 0]) for view in range(truth.shape[1]))
    assert (repeated == image).all()
    mirrored = mirror_reference(scenes)
    assert not torch.equal(mirrored, copied)
    for column in range(truth.shape[-1]):
        assert torch.equal(mirrored[..., column], copied[..., -1 - column])
