"""`completesplat data latents`: stage 1's run to a cache, and training from it."""

import os
import subprocess
import sys

import pytest
from support import LIMIT, SMALL, refused, strict_json

from completesplat.data.loading.latent_cache import LatentCache


def test_a_run_is_encoded_as_asked_and_trained_from(command, pipeline, packed_toys, tmp_path):
    cache, checkpoint = tmp_path / "cache", pipeline.var / "checkpoints/last.ckpt"
    given = [f"ckpt={checkpoint}", f"overrides=['data.root={packed_toys}']", f"out={cache}"]
    made = command("data", "latents", *given, "frames=2", "precision=float16", "batch_size=1")
    assert (made.status, made.out.splitlines()[-1]) == (0, str(cache))
    assert "for 4 frames of 2 sequences" in made.out + made.err
    store = LatentCache(cache)
    assert [sequence.stored for sequence in store.sequences.values()] == [(1, 3)] * 2
    arrays = store.arrays(next(iter(store.sequences)))
    assert (arrays["mean"].dtype, arrays["condition"].dtype) == ("float16", "uint8")

    stage2 = [f"data.root={pipeline.toy}", *SMALL, "experiment=toy_diffusion", "sampler.steps=2", "test=false"]
    stage2 += [f"model.autoreconstructor_checkpoint={checkpoint}", f"data.latent_cache={cache}"]
    assert command("fit", *stage2, f"out={tmp_path / 'run'}").status == 0
    assert strict_json(tmp_path / "run/metrics.json")["steps"] == 2


@pytest.mark.slow
def test_two_processes_write_what_one_writes(pipeline, packed_toys, tmp_path):
    """Three batches: the last one has half of a batch, and no counterpart."""
    given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']", "batch_size=3"]
    torchrun = ["-m", "torch.distributed.run", "--nproc_per_node=2", "--standalone"]
    for out, launcher in (("one", []), ("two", torchrun)):
        program = [sys.executable, *launcher, "-m", "completesplat", "data", "latents", *given, f"out={tmp_path / out}"]
        subprocess.run(program, check=True, timeout=LIMIT, env=os.environ | {"OMP_NUM_THREADS": "1"})
    one, two = (LatentCache(tmp_path / name) for name in ("one", "two"))
    assert (one.origin, one.mean, one.std, one.sequences) == (two.origin, two.mean, two.std, two.sequences)
    files = [(tmp_path / folder / "latents.arrow").read_bytes() for folder in ("one", "two")]
    assert files[0] == files[1]
    assert sum(len(sequence.stored) for sequence in one.sequences.values()) == 8


@pytest.mark.parametrize(
    ("stage", "setting", "message"),
    [
        ("diffusion", "frames=2", "not of stage 1"),
        ("var", "conditioning=learned", "needs images"),
        ("var", "precision=float8", "precision=float8: choose one of float32, float16"),
        ("var", "overrides=[]", "run `completesplat data prepare` first"),
    ],
)
def test_what_cannot_be_encoded_is_refused(pipeline, packed_toys, stage, setting, message):
    checkpoint = getattr(pipeline, stage) / "checkpoints/last.ckpt"
    given = ["data_task=latents", f"ckpt={checkpoint}", f"overrides=['data.root={packed_toys}']", setting]
    assert message in refused("data", *given)


def test_stage_one_does_not_train_from_what_it_would_encode(command, pipeline, latent_cache, tmp_path):
    settings = [f"data.root={pipeline.toy}", *SMALL, "experiment=toy_var", "data.color_jitter=null", "test=false"]
    finished = command("fit", *settings, f"data.latent_cache={latent_cache}", f"out={tmp_path / 'run'}")
    assert (finished.status, "cache is for model=latent_diffusion" in finished.err.splitlines()[-1]) == (2, True)
