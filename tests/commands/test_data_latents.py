"""`completesplat data latents`: stage 1's run to a cache, and training from it."""

import pytest
import torch
from support import SMALL, compose_config, refused, strict_json

from completesplat.commands.jobs import start
from completesplat.data.latent_cache import LatentCache
from completesplat.generation import CompleteSplat


def test_a_run_is_encoded_once_and_trained_from(command, pipeline, packed_toys, tmp_path):
    cache, checkpoint = tmp_path / "cache", pipeline.var / "checkpoints/last.ckpt"
    given = [f"ckpt={checkpoint}", f"overrides=['data.root={packed_toys}']", f"out={cache}"]
    made = command("data", "latents", *given)
    assert made.status == 0
    assert made.out.splitlines()[-1] == str(cache)
    assert "for 8 frames of 2 sequences" in made.out + made.err
    store = LatentCache(cache)
    encoder = CompleteSplat.from_pretrained(pipeline.weights).autoreconstructor.encoder
    for name, sequence in store.sequences.items():
        assert sequence.stored == tuple(range(4))
        scene = store.scene(name, 3)
        with torch.no_grad():
            posterior, _ = encoder(scene.condition[None])
        torch.testing.assert_close(scene.mean, posterior.mean[0], rtol=1e-4, atol=1e-5)

    before = (cache / "mean.npy").stat().st_mtime_ns
    assert command("data", "latents", *given).status == 0
    assert (cache / "mean.npy").stat().st_mtime_ns == before

    stage2 = [f"data.root={pipeline.toy}", *SMALL, "experiment=toy_diffusion", "sampler.steps=2", "test=false"]
    stage2 += [f"model.autoreconstructor_checkpoint={checkpoint}", f"data.latent_cache={cache}"]
    assert command("fit", *stage2, f"out={tmp_path / 'run'}").status == 0
    assert strict_json(tmp_path / "run/metrics.json")["steps"] == 2


@pytest.mark.parametrize(
    ("stage", "setting", "message"),
    [
        ("diffusion", "frames=2", "not of stage 1"),
        ("var", "conditioning=learned", "needs pictures"),
        ("var", "precision=float8", "precision=float8: choose one of float32, float16"),
        ("var", "ckpt=gone.ckpt", "no such checkpoint"),
        ("var", "overrides=[]", "run `completesplat data prepare` first"),
    ],
)
def test_what_cannot_be_encoded_is_refused(pipeline, packed_toys, stage, setting, message):
    checkpoint = getattr(pipeline, stage) / "checkpoints/last.ckpt"
    given = ["data_task=latents", f"ckpt={checkpoint}", f"overrides=['data.root={packed_toys}']", setting]
    assert message in refused("data", *given)


def test_few_frames_and_half_precision_can_be_asked_for(pipeline, packed_toys, tmp_path):
    given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']"]
    few = ["data_task=latents", "frames=2", "precision=float16", "batch_size=1"]
    start("data", compose_config("data", *few, *given), tmp_path / "cache")
    store = LatentCache(tmp_path / "cache")
    assert [sequence.stored for sequence in store.sequences.values()] == [(1, 3)] * 2
    assert store.arrays["mean"].dtype == "float16"
    assert store.arrays["condition"].dtype == "uint8"


def test_stage_one_does_not_train_from_what_it_would_encode(command, pipeline, latent_cache, tmp_path):
    settings = [f"data.root={pipeline.toy}", *SMALL, "experiment=toy_var", "data.color_jitter=null", "test=false"]
    refused = command("fit", *settings, f"data.latent_cache={latent_cache}", f"out={tmp_path / 'run'}")
    assert refused.status == 2
    assert "data.latent_cache is for latent diffusion" in refused.err.splitlines()[-1]
