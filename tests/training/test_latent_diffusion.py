"""What a training step of stage 2 shows to which network, draws, and logs."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scenes_for_training import scene_batch
from support import tiny_generator
from torch import nn

from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import CachedScene, SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion, losses_by_timestep

BATCH = 2
SIZE = 32


def scenes(share: float = 1.0) -> SceneBatch:
    """Return scenes of whose reference images only the left `share` is visible."""
    batch = scene_batch(BATCH, targets=1, size=SIZE)
    batch.visible[..., round(share * SIZE) :] = 0
    return batch


def module_of(monkeypatch, generator=None, **settings) -> tuple[LatentDiffusion, dict[str, float]]:
    """A module without a trainer, and what it logs."""
    surroundings = {"rasterizer": ReferenceRasterizer(), "optimizer": torch.optim.SGD, "schedule": lambda *_: None}
    module = LatentDiffusion(generator or tiny_generator(), **surroundings, **settings)
    logged: dict[str, float] = {}

    def log_loss(errors, timestep):
        values = losses_by_timestep(errors, timestep, module.completesplat.sampler.training_timesteps)
        logged.update(values | {"train/loss": errors.mean().item()})

    monkeypatch.setattr(module, "log_loss", log_loss)
    return module, logged


def gradients(module: LatentDiffusion) -> dict[str, torch.Tensor]:
    return {name: p.grad for name, p in module.named_parameters() if p.grad is not None}


def test_the_conditioning_sees_the_visible_part_and_the_encoder_everything(monkeypatch) -> None:
    batch = scenes(0.5)
    seen = {}
    module, _ = module_of(monkeypatch)
    parts = module.completesplat
    for name, part in (("conditioning", parts.conditioning), ("encoder", parts.autoreconstructor.encoder)):
        part.register_forward_pre_hook(lambda _, inputs, name=name: seen.update({name: inputs[0].clone()}))
    module.training_step(batch, 0)
    assert torch.equal(seen["encoder"], batch.reference.images)
    assert torch.equal(seen["conditioning"], batch.reference.images * batch.visible)


class Recorder(nn.Module):
    """A denoiser that predicts zeros and keeps what it is given."""

    latent_channels = 4

    def forward(self, noisy_latent, timestep, conditioning):
        self.noisy_latent = noisy_latent
        self.timestep = timestep
        self.conditioning = conditioning
        return torch.zeros_like(noisy_latent)


class AsItIs(nn.Module):
    """A frozen conditioning: what was encoded beforehand is used as it is."""

    frozen = True
    pretrained = None


def encoded(count: int) -> CachedScene:
    generator = torch.Generator().manual_seed(0)
    mean, condition = (torch.randn(count, 4, 2, 2, generator=generator) for _ in range(2))
    names = tuple(map(str, range(count)))
    return CachedScene(mean, torch.full_like(mean, -2.0), condition, torch.zeros(count, dtype=torch.int64), names)


def recording(monkeypatch, **settings) -> tuple[LatentDiffusion, dict[str, float]]:
    generator = tiny_generator()
    generator.denoiser, generator.conditioning = Recorder(), AsItIs()
    return module_of(monkeypatch, generator, **settings)


def test_the_conditioning_alone_is_zeroed_at_the_stated_rate(monkeypatch):
    batch = encoded(4000)
    steps = []
    for rate in (0.0, 0.2):
        module, _ = recording(monkeypatch, unconditional_probability=rate)
        torch.manual_seed(0)
        module.training_step(batch, 0)
        steps.append(module.completesplat.denoiser)
    never, sometimes = steps
    assert torch.equal(never.conditioning, batch.condition)
    dropped = (sometimes.conditioning == 0).all((1, 2, 3))
    assert torch.equal(sometimes.conditioning[~dropped], batch.condition[~dropped])
    assert abs(dropped.sum() - 800) <= 5 * math.sqrt(4000 * 0.2 * 0.8)  # standard deviations of the binomial
    assert torch.equal(sometimes.noisy_latent, never.noisy_latent)
    assert torch.equal(sometimes.timestep, never.timestep)


def test_a_scene_gets_several_noises_and_timesteps_and_is_encoded_once(monkeypatch):
    batch = scenes()
    encodings = []
    module, _ = module_of(monkeypatch, noise_draws=3)
    parts = module.completesplat
    shown = Recorder()
    parts.denoiser = shown
    for part in (parts.conditioning, parts.autoreconstructor.encoder):
        part.register_forward_pre_hook(lambda _, inputs: encodings.append(len(inputs[0])))
    torch.manual_seed(0)
    module.unconditional_probability = 0.0
    module.training_step(batch, 0)
    assert encodings == [BATCH, BATCH]
    assert len(shown.noisy_latent) == len(shown.timestep.unique()) == 3 * BATCH
    conditioning = shown.conditioning.view(BATCH, 3, *shown.conditioning.shape[1:])
    assert torch.equal(conditioning, conditioning[:, :1].expand_as(conditioning))
    assert not torch.equal(conditioning[0], conditioning[1])


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_the_loss_is_that_of_the_prediction_type(kind, monkeypatch):
    """For the prediction zero it is the target's mean square: 1 for eps; h and v mix h and eps, uncorrelated."""
    module, logged = recording(monkeypatch)
    module.completesplat.sampler.scheduler.register_to_config(prediction_type=kind)
    batch = encoded(4000)
    loss = module.training_step(batch, 0).item()
    assert logged["train/loss"] == loss
    bar = module.completesplat.sampler.scheduler.alphas_cumprod[module.completesplat.denoiser.timestep]
    power = batch.mean.square().mean((1, 2, 3)) + math.exp(-2)  # of a draw from the posterior
    expected = {"epsilon": torch.ones(()), "sample": power, "v_prediction": bar + (1 - bar) * power}[kind]
    assert loss == pytest.approx(expected.mean().item(), rel=0.03)


def test_the_buckets_losses_average_to_the_total(monkeypatch):
    module, logged = recording(monkeypatch)
    total = module.training_step(encoded(64), 0).item()
    counts = torch.bincount(module.completesplat.denoiser.timestep // 250, minlength=4).tolist()
    assert all(counts)
    of_buckets = [logged[f"train/loss_t{bucket}"] for bucket in range(4)]
    assert len(set(of_buckets)) == 4
    mean = sum(n * value for n, value in zip(counts, of_buckets, strict=True)) / 64
    assert mean == pytest.approx(total, rel=1e-5)
    values = losses_by_timestep(torch.tensor([1.0, 3.0, 5.0]), torch.tensor([249, 250, 499]), 1000)
    assert values == {"train/loss_t0": 1.0, "train/loss_t1": 4.0}


def test_losses_by_timestep_are_logged_once_a_step_and_never_without_an_interval():
    rows = []
    trainer = SimpleNamespace(log_every_n_steps=2)
    loggers = [SimpleNamespace(log_metrics=lambda values, step: rows.append(step))]
    parts = SimpleNamespace(sampler=SimpleNamespace(training_timesteps=1000))
    module = SimpleNamespace(trainer=trainer, loggers=loggers, completesplat=parts, logged_step=-1)
    module.log_step = lambda values, batch_size: None
    for module.global_step, trainer.log_every_n_steps in [(0, 2), (1, 2), (1, 2), (2, 2), (3, 2), (4, 0), (5, 0)]:
        LatentDiffusion.log_loss(module, torch.ones(2), torch.tensor([0, 999]))
    assert rows == [1, 3]


def test_encoded_scenes_train_the_same(monkeypatch):
    batch = scenes(0.5)
    result = []
    for cached in (False, True):
        module, logged = module_of(monkeypatch)
        parts = module.completesplat
        parts.set_latent_moments([0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8])
        inputs: Any = batch
        if cached:
            with torch.no_grad():
                posterior, _ = parts.autoreconstructor.encoder(batch.reference.images)
            image = batch.reference.images * batch.visible
            inputs = CachedScene(posterior.mean, posterior.log_variance, image, batch.reference_frame, batch.names)
        torch.manual_seed(5)
        module.training_step(inputs, 0).backward()
        result.append((logged, gradients(module)))
    (first, first_gradients), (second, second_gradients) = result
    assert first == second
    assert any(name.startswith("completesplat.conditioning") for name in first_gradients)
    torch.testing.assert_close(first_gradients, second_gradients, atol=0, rtol=0)


def test_channels_last_is_the_same_training(monkeypatch):
    result = []
    for channels_last in (False, True):
        module, logged = module_of(monkeypatch, channels_last=channels_last)
        weight = module.completesplat.denoiser.network.conv_in.weight
        assert weight.is_contiguous(memory_format=torch.channels_last) == channels_last
        torch.manual_seed(5)
        module.training_step(scenes(), 0).backward()
        result.append((logged["train/loss"], gradients(module)))
    assert result[0][0] == pytest.approx(result[1][0], rel=1e-5)
    torch.testing.assert_close(result[1][1], result[0][1], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(("compile", "mode"), [(True, "default"), ("cudagraphs", "reduce-overhead")])
def test_a_compiled_denoiser_keeps_its_keys_and_runs_what_the_compiler_returns(monkeypatch, compile, mode):
    compiled = []
    monkeypatch.setattr(torch, "compile", lambda call, mode: lambda *inputs: compiled.append(mode) or call(*inputs))
    module, _ = module_of(monkeypatch, compile=compile)
    assert module.state_dict().keys() == module_of(monkeypatch)[0].state_dict().keys()
    module.training_step(scenes(), 0)
    assert compiled == [mode]


@pytest.mark.parametrize("cached", [False, True])
def test_weights_that_are_too_large_predict_nothing_finite(cached: bool, monkeypatch) -> None:
    module, _ = module_of(monkeypatch)
    batch = scenes()
    if cached:
        posterior = module.completesplat.autoreconstructor.encoder(batch.reference.images)[0].map(torch.Tensor.detach)
        condition = batch.reference.images
        frames = batch.reference_frame
        batch = CachedScene(posterior.mean, posterior.log_variance, condition, frames, batch.names)
    assert module.predicts_finite(batch)
    parameter = next(module.completesplat.denoiser.parameters())
    torch.nn.init.constant_(parameter, 1e38)
    assert parameter.isfinite().all()
    assert not module.predicts_finite(batch)
