"""Runs of `completesplat fit`: their files, scores and refusals, and stage 1 of the paper from CO3D's files."""

import shlex
from pathlib import Path

import pytest
import torch
from co3d_trees import CATEGORY, write_tree
from hydra.utils import instantiate
from lightning import Trainer
from omegaconf import OmegaConf
from pretrained_vaes import random_vae
from small_runs import rows
from support import SMALL, compose_config, strict_json

from completesplat.commands.fit import run
from completesplat.errors import CompleteSplatError


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints/last.ckpt", weights_only=True)["state_dict"]


@pytest.mark.parametrize("stage", ["var", "diffusion"])
def test_a_run_directory_is_complete(pipeline, stage):
    run = getattr(pipeline, stage)
    config = OmegaConf.load(run / "config.yaml")
    assert config.out == str(run)
    assert OmegaConf.to_container(config, resolve=True)["trainer"]["max_steps"] == 2
    metrics = strict_json(run / "metrics.json")
    assert metrics["steps"] == 2
    assert "val/psnr_novel" in metrics
    assert "val/psnr_novel" in rows(run)[0]
    record = strict_json(run / "run.json")
    assert record["command"][0] == "completesplat fit"
    assert record["commit"] is None or len(record["commit"].removesuffix("-dirty")) == 40
    assert torch.load(run / "checkpoints/last.ckpt", weights_only=True)["global_step"] == 2


def test_stage_two_keeps_stage_ones_weights_and_measures_its_latents(pipeline):
    stage1, stage2 = weights(pipeline.var), weights(pipeline.diffusion)
    for name, value in stage1.items():
        kept = stage2[name.replace("model.", "completesplat.autoreconstructor.", 1)]
        torch.testing.assert_close(kept, value, rtol=0, atol=0)
    assert (stage2["completesplat.latent_std"] != 1).all()
    near, far = stage2["completesplat.depth_range"]
    assert 0 < near < far
    assert stage2["completesplat.up"][1] < -0.5  # the toy cameras stand upright


SCORED = ["evaluation.resolution=48", "+evaluation.data.evaluation_targets=1", "seed=4"]


def test_a_fit_has_the_scores_of_a_test_of_its_checkpoint(command, pipeline, tmp_path):
    """In the test's precision, with the protocol's changes to the data, and at its resolution."""
    fit = ["trainer.precision=bf16-mixed", "trainer.max_steps=1", f"data.root={pipeline.toy}"]
    run = tmp_path / "run"
    command.succeeds("fit", "experiment=toy_var", *SMALL, *fit, *SCORED, f"out={run}")
    typed = [f"ckpt={run / 'checkpoints/last.ckpt'}", *SCORED, "trainer.accelerator=cpu", f"out={tmp_path / 'scores'}"]
    command.succeeds("test", *typed)
    ours, theirs = strict_json(run / "metrics.json")["test"], strict_json(tmp_path / "scores/metrics.json")
    assert shlex.split(ours["protocol"]["command"])[:2] == ["completesplat", "fit"]
    assert shlex.split(theirs["protocol"]["command"]) == ["completesplat", "test", *typed]
    for scores in (ours, theirs):
        del scores["protocol"]["command"]
        scores["protocol"]["machine"].pop("date", None)
        assert scores["model"].pop("seconds").keys() == {"inference", "rendering"}
    assert ours == theirs
    assert ours["protocol"]["precision"] == "32-true"
    assert (ours["protocol"]["image_size"], ours["protocol"]["resolution"]) == (32, 48)
    assert ours["model"]["views"] == ours["model"]["scenes"]


def test_a_protocol_that_does_not_fit_is_refused_before_training(toy_root, tmp_path, monkeypatch):
    monkeypatch.setattr(Trainer, "fit", lambda *_, **__: pytest.fail("it trained"))
    given = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "evaluation.scoring.samples=2"]
    with pytest.raises(CompleteSplatError, match="draws no samples"):
        run(compose_config("fit", *given, f"out={tmp_path}"), tmp_path)


def test_a_checkpoint_that_is_missing_or_cut_off_is_refused_before_data_are_made(command, pipeline, tmp_path):
    damaged = tmp_path / "damaged.ckpt"
    damaged.write_bytes((pipeline.var / "checkpoints/last.ckpt").read_bytes()[:-100])
    for path, reason in ((tmp_path / "nowhere.ckpt", "no such checkpoint"), (damaged, "not a readable checkpoint")):
        refused = command.refuses("fit", f"ckpt_path={path}", f"data.root={tmp_path / 'new'}", "data.make=true", *SMALL)
        assert refused.startswith(f"{path}: {reason}")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
@pytest.mark.parametrize("left_out", ["~callbacks.progress", "~callbacks", "~logger"])
def test_a_run_without_callbacks_or_loggers_is_trained_and_scored(command, toy_root, tmp_path, left_out):
    given = [setting for setting in SMALL if not setting.startswith(("callbacks", "trainer.max_steps"))]
    given += ["experiment=toy_var", f"data.root={toy_root}", "trainer.max_steps=1", left_out, f"out={tmp_path / 'run'}"]
    command.succeeds("fit", *given, *([] if left_out == "~callbacks" else ["callbacks.images=null"]))
    metrics = strict_json(tmp_path / "run/metrics.json")
    assert (metrics["steps"], metrics["test"]["model"]["scenes"]) == (1, 1)
    assert (tmp_path / "run/metrics.csv").is_file() == (left_out != "~logger")


@pytest.mark.slow
def test_lightnings_own_checkpoints_may_go_to_a_new_folder_and_its_refusals_are_one_line(command, toy_root, tmp_path):
    given = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "test=false"]
    target, folder = "lightning.pytorch.callbacks.ModelCheckpoint", tmp_path / "new/folder"
    command.succeeds("fit", *given, f"+callbacks.own={{_target_:{target},dirpath:{folder},every_n_train_steps:1}}")
    assert [path.suffix for path in folder.iterdir()] == [".ckpt"]
    assert "trainer: " in command.refuses("fit", *given, "trainer.limit_val_batches=0.1", "out=other")


@pytest.mark.slow
def test_a_training_without_callbacks_is_planned(command):
    assert command("plan", "experiment=toy_var", "~callbacks", "data.image_size=32").status == 0


LISTS = {"train": "abcdef", "val": "g", "test": "hi"}


def test_stage1_starts_from_a_vae_tests_on_unseen_sequences_and_resumes_without_the_vae(command, tmp_path):
    write_tree(tmp_path / "co3d", dict.fromkeys("abcdefghi", 4), LISTS)
    random_vae().save_pretrained(tmp_path / "vae")
    run = tmp_path / "run"
    fit = ["fit", "experiment=paper_var_stage1", f"data.root={tmp_path / 'co3d'}", f"data.category={CATEGORY}"]
    fit += ["data.image_size=32", "data.batch_size=2", "data.workers=0", "rasterizer=tiled", "trainer.accelerator=cpu"]
    fit += ["trainer.max_steps=2", "trainer.max_epochs=null", "trainer.val_check_interval=2", "callbacks.progress=null"]
    fit += ["callbacks.images=null"]
    fit += [f"autoreconstructor.encoder.{name}" for name in ("channels=[8,8,16,16]", "layers_per_block=1")]
    fit += ["autoreconstructor.encoder.norm_groups=4"]

    command.succeeds(*fit, f"out={run}", f"autoreconstructor.pretrained={tmp_path / 'vae'}")
    results = strict_json(run / "metrics.json")
    protocol = results["test"]["protocol"]
    assert results["steps"] == 2
    assert (protocol["subset"], protocol["scenes"], protocol["scenes_listed"]) == ("fewview_dev", 2, 2)
    data = instantiate(OmegaConf.load(run / "config.yaml").data, _convert_="all")
    assert data.source("test").names == list(LISTS["test"])
    assert not set(data.source("train").names) & set(data.source("test").names)
    resume = [f"ckpt_path={run / 'checkpoints/last.ckpt'}", "trainer.max_steps=3", "test=false"]
    command.succeeds(*fit, *resume, f"out={tmp_path / 'more'}")
    assert strict_json(tmp_path / "more/metrics.json")["steps"] == 3
