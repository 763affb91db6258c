"""Training teaches something: minutes, so run by `make test-slow`."""

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import strict_json

from completesplat.metrics.images import psnr
from completesplat.tensors import stack
from completesplat.weights.checkpoint_reading import load_part

pytestmark = pytest.mark.slow
SCENES = ["data.make=true", "data.scenes=24", "data.frames=12", "data.image_size=32", "data.depth_before=1.0"]
SHORT = ["trainer.accelerator=cpu", "trainer.limit_val_batches=0", "callbacks.progress=null"]
SHORT += ["schedule.warmup_steps=20"]


def scores(command, run, out, *changes: str) -> dict:
    assert command("test", f"ckpt={run / 'checkpoints/last.ckpt'}", f"out={out}", *changes).status == 0
    return strict_json(out / "metrics.json")


def test_both_stages_learn(command, tmp_path):
    data = [f"data.root={tmp_path / 'data'}", *SCENES, *SHORT]
    var = tmp_path / "var"
    diffusion = tmp_path / "diffusion"
    # Gentler than the experiment, whose large steps make so short a run end anywhere within 3 dB, seed by seed.
    stage1 = ["experiment=toy_var", "optimizer.lr=1e-3", "trainer.max_steps=600"]
    assert command("fit", *stage1, *data, f"out={var}").status == 0
    stage1 = f"model.autoreconstructor_checkpoint={var / 'checkpoints/last.ckpt'}"
    stage2 = ["experiment=toy_diffusion", stage1, "trainer.max_steps=600"]
    assert command("fit", *stage2, *data, f"out={diffusion}").status == 0

    reconstructed = scores(command, var, tmp_path / "var_scores")
    sampled = scores(command, diffusion, tmp_path / "diffusion_scores")["model"]["full"]
    # Untrained, the renderings are grey blobs: below 13 dB on either.
    assert reconstructed["model"]["full"]["reference"]["psnr"] > 16
    assert reconstructed["model"]["full"]["novel"]["psnr"] > 13.5
    assert sampled["novel"]["psnr"] > reconstructed["model"]["full"]["novel"]["psnr"] - 2.5
    assert sampled["reference"]["psnr"] > 14


def psnr_of_training_views(run) -> torch.Tensor:
    """PSNR in dB of every view of the first training sequence, reconstructed from its first frame."""
    config = OmegaConf.load(run / "config.yaml")
    data, module = (instantiate(part, _convert_="all") for part in (config.data, config.model))
    load_part(module, run / "checkpoints/last.ckpt", prefix="")
    store = data.store("train")
    sequence = store.source.read(store.names[0])
    scenes = stack([store.scene(sequence, 0, range(1, len(sequence.frames)))])
    with torch.no_grad():
        images = module.eval().render(module.reconstruct(scenes), scenes.all_views().cameras)
    return psnr(images[0].clamp(0, 1), scenes.all_views().images[0])


def test_one_scene_is_learned_by_heart(command, tmp_path):
    """Above 28 dB on its training views after 1,000 steps: what is in the way of that is a bug, not the data.

    A clip through a room, of which one image shows nearly all that the others do: all around an object, a single
    image's Gaussians would first have to travel to its far side.
    """
    one_scene = ["data=toy_rooms", "data.make=true", "data.scenes=3", "data.frames=8", "data.max_gap=3"]
    one_scene += ["data.height=32", "data.image_size=32", "data.batch_size=4"]
    settings = [f"data.root={tmp_path / 'data'}", *one_scene, *SHORT]
    steps = ["trainer.max_steps=1000", "test=false", "callbacks.images=null", "data.color_jitter=null"]
    assert command("fit", "experiment=toy_var", *settings, *steps, f"out={tmp_path / 'run'}").status == 0
    values = psnr_of_training_views(tmp_path / "run")
    assert len(values) == 8
    assert values.mean() > 28
