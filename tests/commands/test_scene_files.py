"""`completesplat test scenes=FOLDER`: scenes that any program wrote, scored as our own samples are."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scenes_for_training import scene_batch
from support import call, refused, strict_json
from written_commands import ROOT

from completesplat.errors import CompleteSplatError
from completesplat.export.ply import read_ply, write_ply
from completesplat.gaussians import Gaussians
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.training.scene_files import SceneFiles
from completesplat.training.stage import Stage

SAMPLES = 3
FEW = [f"evaluation.{few}" for few in ("batch=2", "views=1", "spread_views=2", "shown_samples=2")]


@pytest.fixture(scope="module")
def own(pipeline, built_once):
    """Folder with the results of a test of weights (`test`), and the samples that it drew as files (`splats`)."""

    def fill(folder: Path) -> None:
        def write(self, name, gaussians, *images) -> None:
            (folder / "splats" / name).mkdir(parents=True)
            for index, sample in enumerate(gaussians):
                write_ply(folder / f"splats/{name}/sample_{index:02}.ply", sample)

        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(Stage, "scene_scored", write)
            assert call(monkeypatch, "test", f"weights={pipeline.weights}", *given(pipeline, folder / "test")) == 0

    return built_once("own_splats", fill)


def given(pipeline, out: Path) -> list[str]:
    data = ["data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "data.evaluation_targets=2"]
    return [*data, f"evaluation.scoring.samples={SAMPLES}", "trainer.accelerator=cpu", f"out={out}"]


@pytest.fixture
def splats(own, tmp_path) -> Path:
    return shutil.copytree(own / "splats", tmp_path / "splats")


def numbers(entry: dict, place: str = "") -> dict[str, float]:
    flat = {f"{place}{key}": value for key, value in entry.items() if not isinstance(value, dict)}
    return flat | {k: v for key, part in entry.items() if isinstance(part, dict) for k, v in numbers(part, key).items()}


def test_our_own_samples_in_files_score_as_the_model_does(command, pipeline, own, tmp_path):
    finished = command("test", f"scenes={own / 'splats'}", "method=Mine", *given(pipeline, tmp_path / "out"))
    assert finished.status == 0, finished.err
    ours, files = (strict_json(folder / "metrics.json") for folder in (own / "test", tmp_path / "out"))
    assert ours["model"]["seconds"].pop("inference") > 0
    protocols = [scores.pop("protocol") for scores in (ours, files)]
    assert list(ours) == list(files)
    for row in ours:
        expected, actual = ({k: v for k, v in numbers(scores[row]).items() if "rendering" not in k} for scores in (ours, files))
        assert actual == pytest.approx(expected, rel=1e-3, abs=1e-3), row
        psnr = [{k: v for k, v in numbers(scores[row]).items() if k.endswith("psnr")} for scores in (ours, files)]
        assert psnr[1] == pytest.approx(psnr[0], abs=1e-3, rel=0)
    said = {"method": "Mine", "frame": "opencv", "align": "none", "sampler": None, "gaussians": "read from files"}
    assert {key: protocols[1][key] for key in said} == said
    assert protocols[1]["checkpoint"]["path"] == str(own / "splats")
    assert len(protocols[1]["checkpoint"]["sha256"]) == 64
