"""`completesplat test evaluation=hidden_modes`: what it writes, says and refuses, on models without skill."""

import imageio.v3 as imageio
import pytest
from support import strict_json

FEW = [f"evaluation.{few}" for few in ("samples=3", "batch=2", "views=1", "spread_views=2", "shown_samples=2")]
FIGURES = {"coverage", "total_variation", "mode_distance", "rejected", "scenes", "samples"}
FIGURES |= {"energy_hidden", "energy_visible"}
METHODS = {"model", "posterior_mean", "posterior_samples", "other_scene"}


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
