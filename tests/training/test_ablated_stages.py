"""Stage 2 over an ablated stage 1: its latents, and the architecture, are those that stage 1 trained."""

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from scenes_for_training import scene_batch
from support import SMALL, call, compose_config, tiny_generator

import completesplat
from completesplat.evaluation.mode_predictors import LatentDecoding
from completesplat.generator import CompleteSplat
from completesplat.training.encoding import FrameEncoder, fingerprints, moment_sums

SIZE = 32
MASKED = ["experiment=toy_diffusion_masked", "model.checkpoint={}"]
STAGE_2 = ["experiment=toy_diffusion", "model.autoreconstructor_checkpoint={}"]
QUICK = [*SMALL, "test=false", "callbacks.images=null", "trainer.max_steps=1"]


def test_latents_of_a_stage_that_was_not_variational_are_modes_also_when_they_are_cached() -> None:
    model = tiny_generator()
    model.autoreconstructor.variational = False
    scenes = scene_batch(2, targets=0, size=SIZE)
    images = scenes.reference.images
    first, second = (model.encode(images) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(first, model.autoreconstructor.encoder(images)[0].mean)
    rows = FrameEncoder(model.autoreconstructor)(scenes)
    count, total, squares = moment_sums(rows["mean"], rows["log_variance"])
    assert squares / count == pytest.approx(first.double().square().mean((0, 2, 3)).numpy(), rel=1e-5)
    assert total / count == pytest.approx(first.double().mean((0, 2, 3)).numpy(), rel=1e-4, abs=1e-6)
    decoding = LatentDecoding(model.autoreconstructor, samples=2, batch=2)
    scene = scenes[:1]
    samples, mean = (method(scene, scene, 0) for method in (decoding.posterior_samples, decoding.posterior_mean))
    torch.testing.assert_close(samples.means[1:], mean.means)
    modes, _ = fingerprints(model.autoreconstructor, None)
    model.autoreconstructor.variational = True
    assert modes != fingerprints(model.autoreconstructor, None)[0]
    assert not torch.equal(model.encode(images), model.encode(images))


@pytest.fixture(scope="module")
def ablated(toy_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both stages: the first without variational sampling, with one layer and two skips. The second is not told so."""
    root = tmp_path_factory.mktemp("ablated")
    first = ["experiment=toy_var", "ablation=no_variational"]
    first += ["autoreconstructor.reconstructor.parameterization.layers=1"]
    first += ["autoreconstructor.reconstructor.skip_levels=[0,1]"]
    second = [setting.format(root / "first") for setting in STAGE_2]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(root)
        for name, settings in (("first", first), ("second", second)):
            given = [setting for setting in QUICK if not setting.startswith("autoreconstructor") or name == "first"]
            assert call(monkeypatch, "fit", *given, *settings, f"data.root={toy_root}", f"out={root / name}") == 0
    return root


def test_stage_2_takes_the_architecture_of_its_stage_1(ablated: Path) -> None:
    model = CompleteSplat.from_pretrained(ablated / "second").autoreconstructor
    assert not model.variational
    assert model.parameterization.layers == 1
    assert sorted(model.reconstructor.skips) == ["0", "1"]
    assert not CompleteSplat.from_pretrained(ablated / "second/weights").autoreconstructor.variational
    recorded = OmegaConf.load(ablated / "second/config.yaml")
    assert recorded.model.completesplat.autoreconstructor.variational is False


@pytest.mark.parametrize(("start", "run"), [(STAGE_2, "first"), (MASKED, "second")])
def test_stages_in_python_take_the_architecture_of_the_checkpoint_too(start, run, ablated: Path, toy_root) -> None:
    given = [setting for setting in SMALL if not setting.startswith(("trainer", "callbacks", "autoreconstructor"))]
    started = [setting.format(ablated / run / "checkpoints/last.ckpt") for setting in start]
    config = compose_config("fit", f"data.root={toy_root}", *given, *started)
    _, module = completesplat.instantiate(config)
    assert not module.completesplat.autoreconstructor.variational
    assert module.completesplat.autoreconstructor.parameterization.layers == 1
    assert config.autoreconstructor.variational  # the caller's config stays
