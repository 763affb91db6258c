"""`completesplat report`: what it writes, says and refuses, on a model without skill."""

import imageio.v3 as imageio
import pytest
from support import strict_json

FEW = ["scenes=1", "samples=2"]


@pytest.fixture
def report(command, pipeline, tmp_path):
    def run(task: str, *settings: str, run=None):
        checkpoint = (run or pipeline.diffusion) / "checkpoints/last.ckpt"
        return command("report", task, f"ckpt={checkpoint}", *FEW, *settings, f"out={tmp_path / 'out'}")

    return run


def test_samplers_are_measured_from_the_same_noise(report, tmp_path):
    finished = report("samplers", "steps={ddim: [2], dpm: [4], unipc: [3]}")
    assert finished.status == 0
    results = strict_json(tmp_path / "out/samplers.json")
    rows = results["rows"]
    steps = [(row["sampler"], row["steps"], row["calls"]) for row in rows]
    assert steps == [("ddim", 50, 50), ("ddim", 2, 2), ("dpm", 4, 4), ("unipc", 3, 3)]
    assert results["fewest"] in rows
    assert rows[0]["agreement"] == 100  # the limit: with itself
    assert all(10 < row["agreement"] < 100 for row in rows[1:])
    assert imageio.imread(tmp_path / "out/samplers.png").ndim == 3
    assert f"steps: {results['fewest']['calls']} (" in finished.out
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")


def test_controls_hold_the_papers_settings(report, tmp_path):
    finished = report("controls", "skip_weights=[0]", "guidance_weights=[0]", "near_degrees=100")
    assert finished.status == 0
    rows = strict_json(tmp_path / "out/controls.json")["rows"]
    found = [(row["skip_weight"], row["guidance_weight"], row["paper"]) for row in rows]
    assert found == [(0, 0, False), (0, 0.5, True), (0.5, 0.5, True), (1, 0.2, True)]
    assert all(row["diversity"] > 0 and row["near_object_psnr"] > 0 for row in rows)
    for name in ("controls.png", "controls_grid.png"):
        assert imageio.imread(tmp_path / "out" / name).ndim == 3
    assert "Faithfulness" in finished.out


def test_where_no_view_is_near_there_is_no_figure_for_it(report, tmp_path):
    assert report("controls", "skip_weights=[0]", "guidance_weights=[0]", "near_degrees=0").status == 0
    assert {row["near_object_psnr"] for row in strict_json(tmp_path / "out/controls.json")["rows"]} == {None}


def test_completions_of_masked_inputs_are_drawn(report, tmp_path):
    heights = []
    for samples in (2, 3):
        assert report("masked", f"samples={samples}", "views=2").status == 0
        heights.append(imageio.imread(tmp_path / "out/masked.png").shape[0])
    assert heights[0] < heights[1]


@pytest.mark.parametrize(
    ("task", "settings", "said"),
    [
        ("samplers", ["samples=1"], "samples=1: must be at least 2"),
        ("samplers", ["scenes=9"], "there are 1 test scenes, not scenes=9"),
        ("samplers", ["+steps.nonsense=[5]"], "steps.nonsense: no such sampler"),
        ("samplers", ["steps.dpm=[0]"], "steps.dpm=[0]: must lie between 1 and 1000"),
        ("samplers", ["steps.ddim=[30]"], "steps=30: DDIM's must divide 1000"),
        ("samplers", ["skip_weight=2"], "skip_weight=2: must lie between 0 and 1"),
        ("controls", ["guidance_weights=0.5"], "guidance_weights=0.5: must be a list, such as guidance_weights=[0.5]"),
        ("controls", ["skip_weights=[0,2]"], "skip_weight=2: must lie between 0 and 1"),
        ("masked", ["guidance_weight=-1"], "guidance_weight=-1: must lie between 0 and 1"),
        ("masked", ["boxes=[[0,0,0,1]]"], "is no [x0,y0,x1,y1]"),
        ("samplers", ["ckpt=nowhere.ckpt"], "nowhere.ckpt: no such checkpoint"),
    ],
)
def test_refusals_are_one_line_and_status_two(report, task, settings, said):
    finished = report(task, *settings)
    assert finished.status == 2
    assert finished.err.splitlines()[-1].startswith("error: ")
    assert said in finished.err.splitlines()[-1]


def test_a_model_without_samples_is_refused(report, pipeline):
    finished = report("samplers", run=pipeline.var)
    assert finished.status == 2
    assert "a diffusion model is needed" in finished.err
