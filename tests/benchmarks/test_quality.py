"""`completesplat bench quality`: what runs logged, and how long they may take."""

import pytest
from PIL import Image
from support import strict_json

from completesplat.benchmarks.quality import logged, plot
from completesplat.errors import CompleteSplatError

ROWS = """step,speed/scenes_per_second,speed/data_wait,val/psnr_novel
19,80.0,0.5,
39,160.0,0.3,
39,,,15.5
59,160.0,0.1,
79,40.0,0.1,
79,,,18.25
80,40.0,0.1,18.25
"""


def test_seconds_are_those_of_steps(tmp_path):
    (tmp_path / "config.yaml").write_text("data: {batch_size: 8}\n")
    (tmp_path / "metrics.csv").write_text(ROWS)
    training = logged(tmp_path)
    assert training.seconds == [2, 3, 4, 8]  # 20 steps of 8 scenes: 160
    assert training.curve() == [
        {"steps": 40, "seconds": 3, "psnr": 15.5},
        {"steps": 80, "seconds": 8, "psnr": 18.25},
    ]
    assert training.rate() == 40 / 5  # of the second half
    plot({"one": [training.curve()] * 2, "other": [training.curve()]}, tmp_path / "plot.png")
    assert Image.open(tmp_path / "plot.png").size == (1320, 480)


def test_stage1_stands_before_what_builds_on_it(command, tmp_path):
    runs = "runs.autoreconstructor.stage1=latent_diffusion"
    finished = command("bench", "quality", runs, f"out={tmp_path / 'out'}")
    assert finished.status == CompleteSplatError.exit_status
    assert "autoreconstructor builds on 'latent_diffusion', which does not stand before it" in finished.err


@pytest.mark.slow
def test_both_stages_are_trained(command, tmp_path):
    few = [
        "minutes=0.01",
        "points=1",
        "probe=80",
        "seeds=[1]",
        "write.scenes=12",
        "write.frames=4",
        "~runs.splatter_image",
    ]
    finished = command("bench", "quality", *few, f"out={tmp_path}")
    assert finished.status == 0, finished.err
    results = strict_json(tmp_path / "quality.json")
    assert [row["training"] for row in results["rows"]] == ["autoreconstructor", "latent_diffusion"]
    for row in results["rows"]:
        assert 3 < row["psnr"] < 40
        assert row["steps"] % 20 == 0
        assert row["minutes"] > 0
        assert row["training"] in finished.out
    assert not [path for path in tmp_path.iterdir() if path.name.startswith("bench_quality")]
    assert (tmp_path / "quality.png").is_file()
