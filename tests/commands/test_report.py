"""`completesplat report`: what its studies of samples write, say and refuse, on a model without skill."""

import imageio.v3 as imageio
import pytest
from support import refused, strict_json


@pytest.fixture
def report(command, pipeline, tmp_path):
    def run(task: str, *settings: str):
        given = [f"ckpt={pipeline.diffusion / 'checkpoints/last.ckpt'}", "scenes=1", "samples=2", *settings]
        finished = command.succeeds("report", task, *given, f"out={tmp_path / 'out'}")
        return finished.out, strict_json(tmp_path / f"out/{task}.json")

    return run


def weights_of(rows):
    return [(row["skip_weight"], row["guidance_weight"], row["paper"]) for row in rows]


def test_controls_hold_the_papers_settings(report, tmp_path):
    message, results = report("controls", "skip_weights=[0]", "guidance_weights=[0]", "near_degrees=100")
    rows = results["rows"]
    assert weights_of(rows) == [(0, 0, False), (0, 0.5, True), (0.5, 0.5, True), (1, 0.2, True)]
    assert all(row["diversity"] > 0 for row in rows)
    assert all(row["near_object_psnr"] > 0 for row in rows)
    for name in ("controls.png", "controls_grid.png"):
        assert imageio.imread(tmp_path / "out" / name).ndim == 3
    assert "Faithfulness" in message


def test_depth_is_measured_with_the_papers_settings_and_one_is_drawn(report, tmp_path):
    message, results = report("depth", "far_degrees=45")
    assert weights_of(results["rows"]) == [(0, 0.5, True), (0.5, 0.5, True), (1, 0.2, True)]
    assert all(row["reference_deviation"] > 0 and 0 < row["reference_measured"] <= 1 for row in results["rows"])
    assert results["settings"] == {"scenes": 1, "samples": 2, "seed": 0, "far_degrees": 45}
    assert imageio.imread(tmp_path / "out/depth.png").ndim == 3
    assert "Deviation of depth" in message


def test_calibration_of_weights_has_both_regions_and_a_figure(report, pipeline, tmp_path):
    settings = ["ckpt=null", f"weights={pipeline.weights}", "data=toy_objects", f"data.root={pipeline.toy}"]
    message, results = report("calibration", *settings, "samples=3")
    assert results["settings"] == {"scenes": 1, "samples": 3, "seed": 0, "skip_weight": 1, "guidance_weight": 0}
    assert [row["region"] for row in results["rows"]] == ["full", "hidden"]
    assert all(row["spread"] > 0 and sum(row["ranks"]) == pytest.approx(1) for row in results["rows"])
    assert all(row["energy_2"] > 0 and row["energy_3"] > 0 for row in results["rows"])
    assert imageio.imread(tmp_path / "out/calibration.png").ndim == 3
    assert "0.25 of the true values below" in message


@pytest.mark.parametrize(
    ("task", "setting", "message"),
    [
        ("controls", "samples=1", "samples=1: must be at least 2"),
        ("controls", "guidance_weights=0.5", "guidance_weights=0.5: must be a list, such as guidance_weights=[0.5]"),
        ("controls", "seed=0", "nowhere.ckpt: no such checkpoint"),
    ],
)
def test_impossible_settings_are_refused_before_the_model_is_opened(task, setting, message):
    assert message in refused("report", f"report_task={task}", "ckpt=nowhere.ckpt", setting)


def test_settings_that_the_model_or_its_data_cannot_follow_are_refused(pipeline):
    for run, setting, message in (
        (pipeline.diffusion, "scenes=9", "there are 1 test scenes, not scenes=9"),
        (pipeline.var, "samples=2", "a diffusion model is needed"),
    ):
        given = ["report_task=controls", f"ckpt={run / 'checkpoints/last.ckpt'}", "scenes=1", "samples=2"]
        assert message in refused("report", *given, setting)
    given = ["report_task=modes", f"ckpt={pipeline.diffusion / 'checkpoints/last.ckpt'}"]
    assert "these latents are equal in all modes" in refused("report", *given)
