"""`completesplat report depth`: what it writes, says and refuses, on a model without skill."""

import imageio.v3 as imageio
import pytest
from support import strict_json


@pytest.fixture
def report(command, pipeline, tmp_path):
    def run(*settings: str):
        checkpoint = pipeline.diffusion / "checkpoints/last.ckpt"
        return command("report", "depth", f"ckpt={checkpoint}", "scenes=1", *settings, f"out={tmp_path / 'out'}")

    return run


def test_the_papers_settings_are_measured_and_one_is_drawn(report, tmp_path):
    finished = report("samples=2", "far_degrees=45")
    assert finished.status == 0
    results = strict_json(tmp_path / "out/depth.json")
    rows = results["rows"]
    settings = [(row["skip_weight"], row["guidance_weight"], row["paper"]) for row in rows]
    assert settings == [(0, 0.5, True), (0.5, 0.5, True), (1, 0.2, True)]
    assert all(row["reference_deviation"] > 0 and 0 < row["reference_measured"] <= 1 for row in rows)
    assert results["settings"] == {"scenes": 1, "samples": 2, "seed": 0, "far_degrees": 45}
    assert imageio.imread(tmp_path / "out/depth.png").ndim == 3
    assert "Deviation of depth" in finished.out


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("samples=1", "samples=1: must be at least 2"),
        ("skip_weight=2", "skip_weight=2: must lie between 0 and 1"),
        ("far_degrees=-1", "far_degrees=-1: must lie between 0 and 180"),
        ("shown=0", "shown=0: must be at least 1"),
    ],
)
def test_refusals_are_one_line_and_status_two(report, setting, said):
    finished = report(setting)
    assert finished.status == 2
    assert finished.err.splitlines()[-1] == f"error: {said}"
