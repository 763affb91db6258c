"""`completesplat report`: its studies of samples, on a model without skill, and the paper's tables."""

import json

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


def test_settings_that_the_model_or_its_data_cannot_follow_are_refused(pipeline):
    for verb, run, settings, message in (
        ("report", pipeline.diffusion, ["report_task=controls", "scenes=9"], "there are 1 test scenes, not scenes=9"),
        ("report", pipeline.var, ["report_task=controls", "scenes=1"], "a diffusion model is needed"),
        ("test", pipeline.var, ["sampler=dpm20"], "a diffusion model is needed"),
    ):
        assert message in refused(verb, f"ckpt={run / 'checkpoints/last.ckpt'}", *settings)


PROTOCOL = {"data_set": "toy_objects", "resolution": 64, "scenes": 2}


def test_runs_are_listed_beside_the_published_tables_and_broken_files_are_named(command, tmp_path):
    for name in ("good", "bad"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    scores = {"scenes": 2, "views": 4, "full": {"novel": {"psnr": 21.125}}}
    (tmp_path / "runs/good/metrics.json").write_text(json.dumps({"protocol": PROTOCOL, "model": scores}))
    (tmp_path / "runs/bad/metrics.json").write_text("{")
    finished = command.succeeds("report", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert "toy_objects, scores, 64 pixels" in finished.out
    assert "21.12" in finished.out
    assert str(tmp_path / "runs/bad/metrics.json") in finished.out + finished.err
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    for place in ("Table 2", "Table 3", "Table 4", "Table D1"):
        assert all(place in (tmp_path / f"out/tables.{kind}").read_text() for kind in ("md", "csv", "tex"))
