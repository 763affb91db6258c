"""`completesplat bench rasterizers`: what it writes, says and refuses."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from support import strict_json

from completesplat.benchmarks import rasterizers, training_step
from completesplat.benchmarks.workloads import splatter_scene

QUICK = ["bench", "rasterizers", "sizes=[16]", "views=[1]", "repeats=1"]


@pytest.fixture
def garden(tmp_path: Path) -> Path:
    """A scene file without rotations, scales and opacities, as gsplat's is; for images of 24 x 16."""
    gaussians, cameras = splatter_scene(10, 2, "trained", 24)
    colors, path = (gaussians.colors[0] * 255).byte(), tmp_path / "garden.npz"
    matrices = {"viewmats": cameras.world_to_camera[0], "Ks": cameras.intrinsics[0]}
    np.savez(path, means3d=gaussians.means[0], colors=colors, **matrices, width=24, height=16)
    return path


def test_speed_is_written_and_shown(command, tmp_path, monkeypatch):
    """What does not work here is named with the reason."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    switched_off = ["growth=false", "training_step=false"]
    finished = command(*QUICK, "backends=[tiled,reference,cuda]", *switched_off, f"out={tmp_path / 'out'}")
    assert finished.status == 0
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    results = strict_json(tmp_path / "out/rasterizers.json")
    assert set(results) == {"machine", "not_measured", "rows"}
    assert "CUDA device" in results["not_measured"]["cuda"]
    assert [(row["backend"], row["opacity"]) for row in results["rows"]] == [
        (name, opacity) for opacity in ("trained", "initial") for name in ("tiled", "reference")
    ]
    assert {(row["size"], row["gaussians"], row["views"]) for row in results["rows"]} == {(16, 512, 1)}
    missing = f"cuda: not measured, because {results['not_measured']['cuda']}"
    assert all(text in finished.out for text in ("Speed", results["machine"]["processor"], missing))
    assert not (tmp_path / "out/rasterizers.png").exists()


def test_growth_and_the_share_of_a_step_are_written_and_plotted(command, tmp_path, monkeypatch):
    for name, value in {"SOURCE_SIZES": (4, 6), "IMAGE_SIZE": 8, "VIEWS": (1, 2), "IMAGE_SIZES": (4, 8)}.items():
        monkeypatch.setattr(rasterizers, name, value)
    monkeypatch.setattr(training_step, "UNTIMED_STEPS", 0)
    monkeypatch.setattr(training_step, "TIMED_STEPS", 1)
    small = ["training_step.size=32", "training_step.batch=1", "training_step.targets=1", "growth.most_gaussians=40"]
    finished = command(*QUICK, "backends=[tiled]", *small, f"out={tmp_path / 'out'}")
    assert finished.status == 0
    results = strict_json(tmp_path / "out/rasterizers.json")
    points = [(row["backend"], row["axis"], row[row["axis"]]) for row in results["growth"]]
    axes = [("gaussians", 32), ("views", 1), ("views", 2), ("size", 4), ("size", 8)]
    assert points == [("tiled", *point) for point in axes]
    (step,) = results["training_step"]
    assert (step["backend"], step["size"], step["batch"], step["views"]) == ("tiled", 32, 1, 2)
    assert imageio.imread(tmp_path / "out/rasterizers.png").ndim == 3
    assert all(title in finished.out for title in ("Growth", "Share of a training step"))


def test_backends_are_compared_on_a_scene_from_a_file(command, tmp_path, garden):
    named = ["bench", "rasterizers", f"scene={garden}", "backends=[tiled,reference]", "repeats=1"]
    finished = command(*named, f"out={tmp_path / 'out'}")
    assert finished.status == 0
    results = strict_json(tmp_path / "out/rasterizers.json")
    assert set(results) == {"machine", "not_measured", "rows", "scene", "agreement"}
    defaults = ["quats", "scales", "opacities"]
    assert results["scene"] == {"file": str(garden), "height": 16, "width": 24, "defaults": defaults}
    assert [row["backend"] for row in results["rows"]] == ["tiled", "reference"]
    for row in results["rows"]:
        assert (row["size"], row["gaussians"], row["views"], row["opacity"]) == (24, 200, 2, "file")
    (agreement,) = results["agreement"]
    assert (agreement["backend"], agreement["agrees"]) == ("tiled", True)
    assert all(said in finished.out + finished.err for said in ("has no quats, scales, opacities", "opacities=0.5"))


def test_a_refusal_is_one_line_and_status_two(command, tmp_path):
    finished = command("bench", "rasterizers", "sizes=[16,0]", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert finished.err == "error: sizes=[16, 0]: must be at least 1\n"
    assert not (tmp_path / "out/rasterizers.json").exists()
