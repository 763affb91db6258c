"""Stage 2 from the latent cache against stage 2 from pictures, by the command line."""

from pathlib import Path

import pandas
import pytest
import torch
from support import SMALL, call, refused

from completesplat.data.loading.latent_cache import LatentCache

STEPS = 3
QUICK = [*SMALL, f"trainer.max_steps={STEPS}", "trainer.precision=32-true", "trainer.log_every_n_steps=1"]
QUICK += ["callbacks.pictures=null", "callbacks.samples=null", "sampler.steps=1", "test=false"]


@pytest.fixture(scope="module")
def fit(pipeline):
    """Train stage 2 in a folder: from stage 1, and the latents' scale is measured, or on from stage 2, which has it."""

    def run(out: Path, start: str, *settings: str) -> Path:
        stage1, stage2 = (run / "checkpoints/last.ckpt" for run in (pipeline.var, pipeline.diffusion))
        starts = {
            "stage 1": [f"model.autoreconstructor_checkpoint={stage1}"],
            "stage 2": ["model.autoreconstructor_checkpoint=null", f"model.checkpoint={stage2}"],
        }
        given = ["experiment=toy_diffusion", f"data.root={pipeline.toy}", *QUICK, *starts[start], *settings]
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.chdir(out.parent)
            assert call(monkeypatch, "fit", *given, f"out={out}") == 0
        return out

    return run


def logged(run: Path, pattern: str) -> pandas.DataFrame:
    """Rows by step of the columns whose names match; not the last, which repeats what there is at the end."""
    table = pandas.read_csv(run / "metrics.csv")
    return table.groupby("step").max().filter(regex=pattern).dropna(how="all").loc[: STEPS - 1]


def test_losses_are_those_of_training_from_pictures(fit, latent_cache, tmp_path):
    # The loss of a prediction of the latent itself tells more of errors in the latent.
    settings = ["sampler.scheduler.prediction_type=sample"]
    settings += ["data.box_masks={probability: 0.5, boxes: [1, 4], sides: [0.1, 0.5]}"]
    pictures = logged(fit(tmp_path / "pictures", "stage 2", *settings), "^train/loss")
    cached = logged(fit(tmp_path / "cached", "stage 2", *settings, f"data.latent_cache={latent_cache}"), "^train/loss")
    assert list(pictures.index) == list(range(STEPS))
    assert pictures["train/loss"].nunique() == STEPS
    pandas.testing.assert_frame_equal(pictures, cached, rtol=1e-4, atol=0)


def test_the_latents_moments_are_the_caches_and_near_those_that_are_measured(fit, pipeline, latent_cache, tmp_path):
    runs = fit(tmp_path / "run", "stage 1", f"data.latent_cache={latent_cache}"), pipeline.diffusion
    exact, measured = (logged(run, "^latents/std_").iloc[0].tolist() for run in runs)
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
