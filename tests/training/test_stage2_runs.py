"""Stage 2 as it is run: what it starts from, what it keeps, what it writes."""

from functools import partial
from types import SimpleNamespace

import pandas
import pytest
import torch
from hydra.utils import instantiate
from pretrained_vaes import random_vae
from safetensors.torch import load_file
from support import NETWORKS, SMALL, call, compose_config, refused

from completesplat.generator import CompleteSplat
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.weights.checkpoint_reading import read_checkpoint

VAE = ["conditioning=stable_diffusion", "conditioning.channels=[8,8,16,16]"]
VAE += ["conditioning.layers_per_block=1", "conditioning.norm_groups=4"]
QUICK = [*SMALL, "sampler.steps=1", "test=false", "callbacks.images=null", "trainer.log_every_n_steps=1"]
PREFIX = "completesplat."
exactly = partial(torch.testing.assert_close, atol=0, rtol=0)
FROM_STAGE_1 = ["experiment=toy_diffusion", "model.autoreconstructor_checkpoint={var}"]


@pytest.fixture(scope="module")
def run(pipeline, tmp_path_factory) -> SimpleNamespace:
    """A run with Stable Diffusion's conditioning, and the denoiser's weights as they were when it drew samples."""
    root = tmp_path_factory.mktemp("stage2")
    vae = random_vae()
    vae.save_pretrained(root / "vae")
    sampled: dict[str, torch.Tensor] = {}
    reconstruct = LatentDiffusion.reconstruct

    def recorded(self, *inputs, **settings):
        sampled.update({name: value.clone() for name, value in self.completesplat.denoiser.state_dict().items()})
        return reconstruct(self, *inputs, **settings)

    settings = ["experiment=toy_diffusion", f"data.root={pipeline.toy}", *QUICK, *VAE]
    settings += [f"model.autoreconstructor_checkpoint={pipeline.var}"]  # its last checkpoint
    # With a decay so near 1 as for long runs, two steps would leave average and weights apart by little.
    settings += [f"conditioning.pretrained={root / 'vae'}", "callbacks.ema.decay=0.5", f"out={root / 'run'}"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(root)
        monkeypatch.setattr(LatentDiffusion, "reconstruct", recorded)
        assert call(monkeypatch, "fit", *settings) == 0
    checkpoint = torch.load(root / "run/checkpoints/last.ckpt", weights_only=True)
    return SimpleNamespace(folder=root / "run", vae=vae.state_dict(), sampled=sampled, checkpoint=checkpoint)


def part(state: dict[str, torch.Tensor], name: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(name): value for key, value in state.items() if key.startswith(name)}


def test_training_and_averaging_leave_the_frozen_conditioning_unchanged(run):
    for place in ("state_dict", "current_model_state"):
        weights = part(run.checkpoint[place], f"{PREFIX}conditioning.encoder.")
        assert len(weights) > 20
        for name, value in weights.items():
            theirs = name if name.startswith("quant_conv") else name.replace("network.", "encoder.")
            assert torch.equal(value, run.vae[theirs]), name


def test_the_average_is_sampled_and_written(run):
    average, last = (part(run.checkpoint[place], PREFIX) for place in ("state_dict", "current_model_state"))
    denoiser = part(average, "denoiser.")
    assert any(not torch.equal(value, last[f"denoiser.{name}"]) for name, value in denoiser.items())
    exactly(run.sampled, denoiser)
    exactly(load_file(run.folder / "weights/model.safetensors"), average)


def test_the_weights_need_no_vae_any_more_and_hold_facts_about_the_training_images(run, pipeline):
    (run.folder.parent / "vae").rename(run.folder.parent / "elsewhere")
    model = CompleteSplat.from_pretrained(run.folder / "weights")
    assert model.conditioning.frozen
    assert len(model(pipeline.photograph(), samples=1)) == 1
    facts = model.architecture["training"]
    assert facts["box_masks"] == 0
    assert [len(facts[name]) for name in ("picture_mean", "picture_std")] == [8, 8]


def test_the_latents_moments_are_logged(run):
    table = pandas.read_csv(run.folder / "metrics.csv")
    values = table.filter(regex="^latent").dropna()
    assert len(values) == 1
    measured = values.iloc[0]
    for of in ("mean", "std"):
        stored = run.checkpoint["state_dict"][f"{PREFIX}latent_{of}"].flatten().tolist()
        assert measured[[f"latents/{of}_{i}" for i in range(4)]].tolist() == pytest.approx(stored)
    assert len(set(stored)) == 4


def test_masked_diffusion_starts_from_all_weights_of_the_main_stage(pipeline):
    checkpoint = pipeline.diffusion / "checkpoints/last.ckpt"
    settings = ["rasterizer=reference", "data.image_size=32", *NETWORKS, f"model.checkpoint={checkpoint}"]
    config = compose_config("fit", "experiment=toy_diffusion_masked", *settings)
    started = instantiate(config.model, _convert_="all")
    exactly(started.state_dict(), read_checkpoint(checkpoint)["state_dict"])
    assert (started.completesplat.latent_std != 1).all()
    assert started.skip_weight == 1  # as in the tables; a prediction takes 0 where something is hidden


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["experiment=toy_diffusion_masked", "model.checkpoint={var}"], "is missing there"),
        ([*FROM_STAGE_1, "model.checkpoint={diffusion}"], "set model.autoreconstructor_checkpoint=null"),
        (
            [FROM_STAGE_1[0], "model.autoreconstructor_checkpoint=null"],
            "stage 2 needs weights: give model.autoreconstructor_checkpoint=FILE",
        ),
        ([*FROM_STAGE_1, *VAE], "give conditioning.pretrained=DIR"),
        ([*FROM_STAGE_1, "conditioning.channels=[8,8,16]"], "latents are 4x4 and the conditioning's features 8x8"),
    ],
)
def test_starts_that_cannot_work_are_refused(pipeline, settings, message, tmp_path):
    files = {stage: getattr(pipeline, stage) / "checkpoints/last.ckpt" for stage in ("var", "diffusion")}
    given = [setting.format(**files) for setting in settings]
    assert message in refused("fit", f"data.root={pipeline.toy}", *QUICK, *given, f"out={tmp_path / 'run'}")
