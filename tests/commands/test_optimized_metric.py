"""Jobs tell sweepers a figure, so that these can look for good settings."""

import json
import math

import pytest
from omegaconf import OmegaConf
from support import SMALL, strict_json

from completesplat.commands.jobs import optimized
from completesplat.errors import CompleteSplatError

FIGURES = {"steps": 2, "val/psnr_novel": 20.5, "val/loss": None, "upper_bound": False, "test": {"x": 1.0}}


def test_a_job_returns_the_figure_that_is_asked_for_and_names_those_that_it_has(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(FIGURES | {"not_finite": ["val/loss: nan"]}))
    assert optimized(None, tmp_path) is None
    assert optimized("val/psnr_novel", tmp_path) == 20.5
    assert math.isnan(optimized("val/loss", tmp_path))
    there_are = r", there are val/psnr_novel, val/loss; did you mean val/psnr_nov"
    for name, others in (("val/psnr", there_are), ("steps", ""), ("upper_bound", ""), ("test", "")):
        with pytest.raises(CompleteSplatError, match=f"^optimized_metric={name}: no figure in .*{others}"):
            optimized(name, tmp_path)


def test_a_finished_run_returns_its_metric(command, pipeline):
    settings = ["experiment=toy_var", f"data.root={pipeline.toy}", *SMALL, "ckpt_path=last", f"out={pipeline.var}"]
    refused = command.refuses("fit", *settings, "optimized_metric=val/psnr_novl")
    assert refused.startswith("optimized_metric=val/psnr_novl: no figure in ")
    assert "val/psnr_novel" in refused
    again = command.succeeds("fit", *settings, "optimized_metric=val/psnr_novel")
    assert "finished before, not repeated" in again.out


@pytest.mark.slow
def test_optuna_finds_the_better_of_two_settings(command, toy_root, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
    settings = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "callbacks.images=null", "test=false"]
    sweep = ["-m", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "hydra.sweeper.direction=maximize"]
    sweep += ["optimized_metric=val/psnr_novel", "model.background=choice(0.0,1.0)", "hydra.sweeper.sampler.seed=1"]
    command.succeeds("fit", *sweep, *settings, "out=SEARCH")
    best = OmegaConf.load(tmp_path / "SEARCH/optimization_results.yaml")
    result = [strict_json(path)["val/psnr_novel"] for path in tmp_path.glob("SEARCH/*/metrics.json")]
    assert best.best_value == max(result)
