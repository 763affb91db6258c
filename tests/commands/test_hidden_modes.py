"""`completesplat test evaluation=hidden_modes`: what it writes, says and refuses, on models without skill."""

import imageio.v3 as imageio
import pytest
from support import compose_config, strict_json

from completesplat.commands.jobs import start
from completesplat.errors import CompleteSplatError

FEW = ["samples=3", "batch=2", "views=1", "spread_views=2", "shown_samples=2"]
FIGURES = {"coverage", "total_variation", "sharpness", "rejected", "scenes", "samples"}


@pytest.fixture
def measured(command, pipeline, tmp_path):
    def run(folder, *settings):
        few = [f"evaluation.{setting}" for setting in FEW]
        given = ["test", "evaluation=hidden_modes", f"ckpt={folder / 'checkpoints/last.ckpt'}", *few, *settings]
        return command(*given, f"out={tmp_path / 'out'}")

    return run


@pytest.mark.parametrize(
    ("stage", "methods"),
    [
        ("diffusion", {"model"}),
        pytest.param("var", {"model", "posterior_samples"}, marks=pytest.mark.slow),
    ],
    ids=["diffusion", "var"],
)
def test_every_method_is_scored(measured, pipeline, tmp_path, stage, methods):
    finished = measured(getattr(pipeline, stage))
    assert finished.status == 0, finished.err
    results = strict_json(tmp_path / "out/hidden_modes.json")
    assert set(results) == methods | {"mean_predictor", "true_sampler"}
    for method, found in results.items():
        assert set(found) == FIGURES
        assert (found["scenes"], found["samples"]) == (1, 3)
        assert method in finished.out
    mean, true = results["mean_predictor"], results["true_sampler"]
    assert (mean["coverage"], mean["total_variation"], mean["rejected"]) == (0, 1, 1)
    assert (true["sharpness"], true["rejected"]) == (0, 0)
    assert true["coverage"] <= 0.75  # three draws of four modes
    calibration = strict_json(tmp_path / "out/calibration.json")
    assert set(calibration) == methods
    for found in calibration.values():
        # Two spread views, one of which may be the one from behind.
        assert found["hidden"]["pixels"] + found["visible"]["pixels"] in (2 * 32**2, 3 * 32**2)
    drawn = calibration["posterior_samples" if stage == "var" else "model"]
    assert drawn["hidden"]["variance"] > 1e-10
    if stage == "var":  # its mode is one answer
        assert calibration["model"]["hidden"]["variance"] == pytest.approx(0, abs=1e-12)
    assert imageio.imread(tmp_path / "out/hidden_modes.png").ndim == 3
    assert strict_json(tmp_path / "out/protocol.json")["skipped"] == []


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ("samples=1", "evaluation.samples=1: must be at least 2"),
        ("views=0", "evaluation.views=0: must be at least 1"),
        ("scenes=0", "evaluation.scenes=0: must be at least 1"),
    ],
)
def test_too_small_numbers_are_refused(setting, reason, tmp_path):
    config = compose_config("test", "evaluation=hidden_modes", "ckpt=none", f"evaluation.{setting}")
    with pytest.raises(CompleteSplatError, match=reason):
        start("test", config, tmp_path)
