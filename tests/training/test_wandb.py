"""What runs leave for Weights & Biases, without a network."""

from functools import cache
from pathlib import Path

import pytest
import torch
from support import SMALL, call
from wandb_files import logged, offline_runs

from completesplat.training.reconstruction import ReconstructionModule

pytest.importorskip("wandb")
pytestmark = pytest.mark.processes

STAGE1 = "stage 1"
STAGE2 = "stage 2"
TEST = "test"
MODES = "hidden modes"
FIT, TESTED = (STAGE1, STAGE2), (STAGE1, STAGE2, TEST)  # `fit` ends with a test
# The kind of the values, the runs that log them, and their keys; `*` stands for anything.
LOGGED = [
    ("number", FIT, "train/loss val/loss val/psnr_novel"),
    ("number", FIT, "gaussians/opacity_p* gaussians/log10_scale_p* gaussians/depth_p*"),
    ("number", FIT, "layers/opacity_* layers/behind_*"),
    ("number", FIT, "speed/scenes_per_second speed/data_wait train/bad_steps train/learning_rate train/gradient_norm"),
    ("number", FIT if Path("/proc/self/status").exists() else (), "memory/process_gb"),
    ("number", FIT if torch.cuda.is_available() else (), "memory/gpu_gb"),
    ("image", FIT, "images"),
    ("video", FIT, "turn"),
    ("number", (STAGE1,), "train/psnr train/mse train/ssim train/kl latent/bits latent/bits_* latent/active_channels"),
    ("number", (STAGE2,), "train/loss_t* samples/psnr samples/psnr_of_mean samples/diversity"),
    ("number", (STAGE2,), "latents/std_* latents/mean_*"),
    ("image", (STAGE2,), "samples"),
    (
        "number",
        TESTED,
        "test/full/* test/object/* test/mean_image/* test/copy_reference/* test/mirrored_reference/* "
        "test/flat_reference/*",
    ),
    ("number", (TEST,), "test/best_of_k/* test/best_of_k_by_metric/* test/mean_of_k/*"),
    ("number", (MODES,), "hidden_modes/*"),
]
UNNAMED = {"train/scale", "train/opacity"}  # regularisers, off by default
FEW_MODES = ["evaluation=hidden_modes", "evaluation.samples=2", "evaluation.views=1", "evaluation.spread_views=1"]


def fit_settings(pipeline, stage: str) -> list[str]:
    stage1 = f"model.autoreconstructor_checkpoint={pipeline.var / 'checkpoints/last.ckpt'}"
    own = ["experiment=toy_diffusion", stage1, "sampler.steps=2"] if stage == STAGE2 else ["experiment=toy_var"]
    return [*own, f"data.root={pipeline.toy}", *SMALL, "trainer.log_every_n_steps=1"]


@pytest.fixture(scope="module")
def run(pipeline, tmp_path_factory):
    """One W&B run, and its directory, for each kind; made when first asked for."""

    @cache
    def make(kind: str):
        out = tmp_path_factory.mktemp("wandb") / "run"
        test = ["test", f"ckpt={pipeline.diffusion / 'checkpoints/last.ckpt'}"]
        tests = {TEST: [*test, "evaluation.scoring.samples=2", "trainer.accelerator=cpu"], MODES: [*test, *FEW_MODES]}
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.delenv("WANDB_MODE", raising=False)
            monkeypatch.chdir(out.parent)
            # Only rows of two batches have the wait between them.
            fit = ["fit", *fit_settings(pipeline, kind), "trainer.log_every_n_steps=2"]
            given = tests.get(kind, fit)
            assert call(monkeypatch, *given, "logger=wandb", f"out={out}") == 0
        return (*offline_runs(out), out)

    return make


@pytest.mark.slow
@pytest.mark.parametrize("kind", [STAGE1, STAGE2, TEST, MODES])
def test_a_run_logs_all_that_is_listed_and_nothing_else(run, kind):
    values = run(kind)[0].merged()
    result = {keys: logged(values, keys, of) for of, runs, names in LOGGED for keys in names.split() if kind in runs}
    assert [keys for keys, matching in result.items() if not matching] == []
    media = [key.removesuffix("_type") for key in values if key.endswith("/_type")]
    rest = {key for key in values if not key.startswith(("_", *media))}
    assert rest - set().union(*result.values()) <= {"epoch", "trainer/global_step", *UNNAMED}


@pytest.mark.slow
def test_jobs_of_a_sweep_are_a_group_and_a_continued_job_is_the_same_run(command, pipeline, tmp_path, monkeypatch):
    step = ReconstructionModule.training_step
    failed = []

    def failing(self, scenes, index):
        if self.global_step == 1 and not failed:
            failed.append(index)
            raise RuntimeError("the first job, in its second step")
        return step(self, scenes, index)

    monkeypatch.setattr(ReconstructionModule, "training_step", failing)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    sweep = ["-m", *fit_settings(pipeline, STAGE1), "logger=wandb", "seed=0,1", f"out={tmp_path / 'some_sweep'}"]
    sweep += ["test=false", "callbacks.checkpoint.every_n_train_steps=1", "callbacks.images=null"]
    with pytest.raises(RuntimeError, match="the first job"):
        command("fit", *sweep)
    assert command("fit", *sweep).status == 0
    first, second = (offline_runs(tmp_path / "some_sweep" / f"seed-{seed}") for seed in (0, 1))
    assert [[one.only("exit").exit_code for one in job] for job in (first, second)] == [[1, 0], [0]]
    started, continued, other = (one.only("run") for one in (*first, *second))
    told = [(one.run_group, one.display_name) for one in (started, continued, other)]
    assert told == [("some_sweep", "seed-0"), ("some_sweep", "seed-0"), ("some_sweep", "seed-1")]
    assert started.run_id == continued.run_id != other.run_id
    steps = [[row["trainer/global_step"] for row in one.history if "train/mse" in row] for one in first]
    assert steps[0] == [0]
    assert set(steps[1]) == {1, 2}  # and behind the end the last figures again
