import shutil

import pytest
from omegaconf import OmegaConf
from support import strict_json

from completesplat.diffusion.sampling import Sampler


@pytest.mark.parametrize("stage", ["var", "diffusion"])
def test_scores_stand_beside_the_naive_predictors(command, pipeline, tmp_path, stage):
    checkpoint = getattr(pipeline, stage) / "checkpoints/last.ckpt"
    finished = command("test", f"ckpt={checkpoint}", f"out={tmp_path / 'scores'}", "trainer.accelerator=cpu")
    assert finished.status == 0
    assert finished.out.splitlines()[-1] == str(tmp_path / "scores")
    metrics = strict_json(tmp_path / "scores" / "metrics.json")
    assert list(metrics) == ["model", "mean_image", "copy_reference"]
    for scores in metrics.values():
        for region in ("full", "object"):
            for view in ("novel", "reference"):
                assert 0 < scores[region][view]["psnr"] <= 100
                assert -1 <= scores[region][view]["ssim"] <= 1
        assert scores["scenes"] > 0
        assert scores["views"] == scores["scenes"] * 2
    assert metrics["copy_reference"]["full"]["reference"]["psnr"] == 100
    assert "copy_reference" in finished.out


def test_the_runs_configuration_can_be_changed(command, pipeline, tmp_path):
    checkpoint = pipeline.var / "checkpoints/last.ckpt"
    change = "overrides=['data.evaluation_targets=1']"
    assert command("test", f"ckpt={checkpoint}", change, f"out={tmp_path / 'one'}").status == 0
    model = strict_json(tmp_path / "one" / "metrics.json")["model"]
    assert model["views"] == model["scenes"]


def test_weights_that_only_training_needed_may_be_gone(command, pipeline, tmp_path):
    shutil.copytree(pipeline.var, tmp_path / "run")
    config = OmegaConf.load(tmp_path / "run/config.yaml")
    lpips = "completesplat.losses.lpips.LearnedPerceptualSimilarity"
    term = {"weight": 0.01, "term": {"_target_": lpips, "vgg_weights": "gone.pth"}}
    OmegaConf.update(config, "model.loss.terms.lpips", term, force_add=True)
    config.model.model.pretrained, config.model.checkpoint = "gone", "gone.ckpt"
    OmegaConf.save(config, tmp_path / "run/config.yaml")
    checkpoint = tmp_path / "run/checkpoints/last.ckpt"
    assert command("test", f"ckpt={checkpoint}", f"out={tmp_path / 'scores'}").status == 0


def test_samples_can_be_drawn_by_another_sampler(command, pipeline, tmp_path, monkeypatch):
    used = []
    draw = Sampler.__call__

    def watched(self, *arguments):
        used.append((type(self.scheduler).__name__, self.steps))
        return draw(self, *arguments)

    monkeypatch.setattr(Sampler, "__call__", watched)
    checkpoint = f"ckpt={pipeline.diffusion / 'checkpoints/last.ckpt'}"
    assert (
        command("test", checkpoint, "sampler=dpm10", "trainer.accelerator=cpu", f"out={tmp_path / 'out'}").status == 0
    )
    assert set(used) == {("DPMSolverMultistepScheduler", 10)}


def test_a_sampler_for_a_model_without_samples_is_refused(command, pipeline, tmp_path):
    checkpoint = f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}"
    finished = command("test", checkpoint, "sampler=dpm10", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert "a diffusion model is needed" in finished.err.splitlines()[-1]
