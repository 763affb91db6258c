"""Stage 2 from the latent cache against stage 2 from images, by the command line."""

from pathlib import Path

import pandas
import pytest
import torch
from support import SMALL, refused

from completesplat.data.loading.latent_cache import LatentCache

LAST = "checkpoints/last.ckpt"
STEPS = 3
QUICK = [*SMALL, f"trainer.max_steps={STEPS}", "trainer.precision=32-true", "trainer.log_every_n_steps=1"]
QUICK += ["callbacks.images=null", "callbacks.samples=null", "sampler.steps=1", "test=false"]


def logged(run: Path, pattern: str) -> pandas.DataFrame:
    """Rows by step of the columns whose names match; not the last, which repeats what there is at the end."""
    table = pandas.read_csv(run / "metrics.csv")
    return table.groupby("step").max().filter(regex=pattern).dropna(how="all").loc[: STEPS - 1]


def test_losses_are_those_of_training_from_images(pipeline, latent_cache, tmp_path, command):
    """From stage 2, which has the latents' scale."""
    settings = ["fit", "experiment=toy_diffusion", f"data.root={pipeline.toy}", *QUICK]
    settings += [f"model.checkpoint={pipeline.diffusion / LAST}", "model.autoreconstructor_checkpoint=null"]
    # The loss of a prediction of the latent itself shows more of errors in the latent.
    settings += ["sampler.scheduler.prediction_type=sample"]
    settings += ["data.box_masks={probability: 0.5, boxes: [1, 4], sides: [0.1, 0.5]}"]
    for name, cache in {"images": "null", "cached": latent_cache}.items():
        assert command(*settings, f"data.latent_cache={cache}", f"out={tmp_path / name}").status == 0
    images, cached = (logged(tmp_path / name, "^train/loss") for name in ("images", "cached"))
    assert list(images.index) == list(range(STEPS))
    assert images["train/loss"].nunique() == STEPS
    pandas.testing.assert_frame_equal(images, cached, rtol=1e-4, atol=0)


def test_the_latents_moments_are_the_caches_and_near_those_that_are_measured(pipeline, latent_cache, tmp_path, command):
    settings = ["fit", "experiment=toy_diffusion", f"data.root={pipeline.toy}", *QUICK, "trainer.max_steps=1"]
    settings += [f"model.autoreconstructor_checkpoint={pipeline.var / LAST}", f"data.latent_cache={latent_cache}"]
    assert command(*settings, f"out={tmp_path / 'run'}").status == 0
    exact, measured = (logged(run, "^latents/std_").iloc[0].tolist() for run in (tmp_path / "run", pipeline.diffusion))
    assert exact == pytest.approx(LatentCache(latent_cache).std)
    draws = 2 * 4 * 4  # of each channel: one batch of two scenes; a deviation is then known to 1 / sqrt(2 draws)
    assert measured == pytest.approx(exact, rel=3 / (2 * draws) ** 0.5)


def test_the_cache_of_another_autoreconstructor_is_refused(pipeline, latent_cache, tmp_path):
    checkpoint = torch.load(pipeline.var / "checkpoints/last.ckpt", weights_only=True)
    next(v for name, v in checkpoint["state_dict"].items() if name.startswith("model.encoder.")).view(-1)[0] += 1
    torch.save(checkpoint, other := tmp_path / "other.ckpt")
    given = ["experiment=toy_diffusion", f"data.root={pipeline.toy}", *QUICK, f"data.latent_cache={latent_cache}"]
    line = refused("fit", *given, f"model.autoreconstructor_checkpoint={other}", f"out={tmp_path}")
    assert "made with another autoreconstructor" in line
    assert list(tmp_path.iterdir()) == [other]
