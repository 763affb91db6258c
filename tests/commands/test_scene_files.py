"""`completesplat test scenes=FOLDER`: scenes that any program wrote, scored like samples of our models."""

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scenes_for_training import scene_batch
from support import call, strict_json
from written_commands import ROOT, arguments_of, block_commands

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.paper_tables import published_tables
from completesplat.evaluation.ply_samples import PlySamples
from completesplat.evaluation.records import find_results, flat_scores
from completesplat.evaluation.scorer import Scorer
from completesplat.evaluation.table_writers import as_markdown
from completesplat.export.ply import read_ply, write_ply
from completesplat.gaussians import Gaussians
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import SceneBatch

SAMPLES = 3
FEW = [f"evaluation.{few}" for few in ("batch=2", "views=1", "spread_views=2", "shown_samples=2")]


@pytest.fixture(scope="module")
def model_test(pipeline, built_once):
    """Folder with the results of testing weights (`test`) and the drawn samples as files (`splats`)."""

    def fill(folder: Path) -> None:
        def write(self, name, gaussians, *images) -> None:
            (folder / "splats" / name).mkdir(parents=True)
            for index, sample in enumerate(gaussians):
                write_ply(folder / f"splats/{name}/sample_{index:02}.ply", sample)

        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(Scorer, "scene_scored", write)
            assert call(monkeypatch, "test", f"weights={pipeline.weights}", *toy_data(pipeline, folder / "test")) == 0

    return built_once("own_splats", fill)


def toy_data(pipeline, out: Path) -> list[str]:
    data = ["data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "data.evaluation_targets=2"]
    return [*data, f"evaluation.scoring.samples={SAMPLES}", "trainer.accelerator=cpu", f"out={out}"]


def test_samples_score_the_same_from_files_as_from_the_model(command, pipeline, model_test, tmp_path):
    given = [f"scenes={model_test / 'splats'}", "method=Mine", *toy_data(pipeline, tmp_path / "out")]
    finished = command.succeeds("test", *given)
    ours, files = (strict_json(folder / "metrics.json") for folder in (model_test / "test", tmp_path / "out"))
    _, described = ours.pop("protocol"), files.pop("protocol")
    assert ours["model"]["seconds"].pop("inference") > 0
    assert files["model"]["seconds"].keys() == {"rendering"}
    assert list(ours) == list(files)
    for row in ours:
        expected, actual = (flat_scores(scores[row]) for scores in (ours, files))
        assert expected.keys() == actual.keys()
        for name in expected:
            if "seconds" not in name:
                assert actual[name] == pytest.approx(expected[name], abs=1e-3), (row, name)
    assert "│ Mine (read from files) " in finished.out
    assert "│ model " not in finished.out
    named = {"method": "Mine (read from files)", "frame": "opencv", "align": "none", "sampler": None}
    assert {key: described[key] for key in named} == named
    assert described["checkpoint"]["path"] == str(model_test / "splats")
    assert len(described["checkpoint"]["sha256"]) == 64
    text = "\n".join(map(as_markdown, published_tables(find_results(tmp_path))))
    assert "| Mine (read from files), single sample [1] |" in text
    assert "| completesplat: copy reference [1] |" in text
    assert "frame opencv, align none, checkpoint sha256 " in text


def written(folder: Path, samples: Sequence[Gaussians], scene: str = "scene 0 0") -> Path:
    """Write samples of one scene and return `folder`."""
    (folder / scene).mkdir(parents=True)
    for index, sample in enumerate(samples):
        write_ply(folder / f"{scene}/sample_{index:02}.ply", sample)
    return folder


def in_front(count: int = 40, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    means, quaternions, scales, rest = (torch.rand(count, n, generator=generator) for n in (3, 4, 3, 4))
    means = (means - 0.5) * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.0, 0.0, 2.0])
    return Gaussians(means, quaternions - 0.5, 0.05 + 0.2 * scales, 0.5 + 0.5 * rest[:, 3], rest[:, :3])


def drawn(folder: Path, scenes: SceneBatch, samples: int, frame: str = "opencv", align: str = "none") -> Gaussians:
    stage = PlySamples(str(folder), frame, align, None, rasterizer=ReferenceRasterizer())
    stage.find_files(scenes.names, samples)
    return stage.draw(scenes, [0], samples)


def test_files_with_opengl_axes_are_rotated_about_x(tmp_path):
    samples, flip = [in_front(40), in_front(25, seed=1)], torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    i = lambda quaternions: quaternions[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1, -1, 1])  # noqa: E731
    turned = [replace(one, means=one.means @ flip, quaternions=i(one.quaternions)) for one in samples]
    for sample, other in zip(samples, turned, strict=True):  # i q = (-x, w, -z, y)
        assert torch.allclose(other.covariances(), flip @ sample.covariances() @ flip, atol=1e-6)
    result = drawn(written(tmp_path, turned), scene_batch(batch=1), 2, frame="opengl")
    assert result.opacities.shape == (2, 40)
    assert not result.opacities[1, 25:].any()
    for sample, placed in zip(samples, result, strict=False):
        placed = placed[: sample.count]
        assert torch.allclose(placed.means, sample.means, atol=1e-5)
        assert torch.allclose(placed.covariances(), sample.covariances(), atol=1e-5)


def test_align_scale_fits_one_factor_for_each_scene_to_true_depth(tmp_path):
    samples, scenes = [in_front(), in_front(seed=1)], scene_batch(batch=1)
    camera = scenes.reference.cameras[0]
    view = ReferenceRasterizer()(samples[0][None], camera[None][None])[0, 0]
    depths = torch.where(view.alpha > 0.6, view.expected_depth(), torch.zeros(()))[None]
    with_depth = replace(scenes, reference=replace(scenes.reference, depths=depths))
    smaller = [replace(sample, means=sample.means / 3, scales=sample.scales / 3) for sample in samples]
    result = drawn(written(tmp_path / "a", smaller), with_depth, 2, align="scale")
    for name in ("means", "scales"):
        expected = torch.stack([getattr(sample, name) for sample in samples])
        assert torch.allclose(getattr(result, name), expected, rtol=1e-3, atol=1e-4)
    zeros = replace(scenes, reference=replace(scenes.reference, depths=torch.zeros_like(depths)))
    for without_depth in (scenes, zeros):
        with pytest.raises(CompleteSplatError, match=r"align=scale: scene 0 0: no true depth .* align=none"):
            drawn(tmp_path / "a", without_depth, 2, align="scale")


def behind(folder: Path) -> None:
    for path in folder.glob("*.ply"):
        sample = read_ply(path)
        signs = torch.ones(sample.count).index_fill(0, torch.arange(sample.count // 50), -1.0)  # a few are stray
        write_ply(path, replace(sample, means=-signs[:, None] * sample.means))


REFUSED = [
    (shutil.rmtree, r": no such folder, 3 files are needed \(1 of 1 scenes have too few\); write them"),
    (lambda at: (at / "sample_00.ply").unlink(), r": 2 files sample_\*.ply, 3 files are needed .*; .*fewer"),
    (behind, "/sample_00.ply: nearly all .* behind the camera; try frame=opengl"),
    (lambda at: write_ply(at / "sample_01.ply", in_front(0)), "/sample_01.ply: holds 0 Gaussians; write it again"),
    (lambda at: (at / "sample_02.ply").write_bytes(b"ply"), "/sample_02.ply: no end of the header"),
]


@pytest.mark.parametrize(("damage", "message"), REFUSED, ids=range(len(REFUSED)))
def test_scenes_that_cannot_be_scored_are_named_in_one_line(command, pipeline, model_test, tmp_path, damage, message):
    (scene,) = shutil.copytree(model_test / "splats", tmp_path / "splats").iterdir()
    damage(scene)
    finished = command("test", f"scenes={tmp_path / 'splats'}", *toy_data(pipeline, tmp_path / "out"))
    (line,) = [line for line in finished.err.splitlines() if line.startswith("error: ")]
    assert finished.status == 2
    assert re.search(f"{scene}{message}", line), line
    assert not (tmp_path / "out/metrics.json").exists()


def test_hidden_modes_are_scored_from_files(command, pipeline, model_test, tmp_path):
    settings = ["evaluation=hidden_modes", "evaluation.samples=3", "align=scale", *FEW]
    data = [setting for setting in toy_data(pipeline, tmp_path / "out") if "scoring" not in setting]
    command.succeeds("test", f"scenes={model_test / 'splats'}", *settings, *data)
    results = strict_json(tmp_path / "out/hidden_modes.json")
    assert results.keys() == {"model", "true_sampler", "mean_predictor"}
    assert strict_json(tmp_path / "out/protocol.json")["method"] == "splats (read from files)"
    finished = command("test", f"scenes={model_test / 'splats'}", *settings, "evaluation.samples=4", *data)
    assert "3 files sample_*.ply, 4 files are needed" in finished.err


@pytest.mark.slow
def test_the_lines_of_the_readme_run_as_written(command, tmp_path):
    document = ROOT / "completesplat/evaluation/README.md"
    (lines,) = re.findall(r"```python\n(.*?)```", document.read_text(), re.DOTALL)
    # The board's protocol needs all scenes of HELDOUT, of which a few are made here.
    named = [text for text in block_commands(document) if re.search("HELDOUT|SPLATS", text)]
    making, *commands = [arguments_of(text) for text in dict.fromkeys(named) if "evaluation=toys" not in text]
    command.succeeds(*making, "scenes=20", "frames=8")
    exec(lines, {})
    for arguments in commands:
        command.succeeds(*arguments, "evaluation.views=1" if "evaluation=hidden_modes" in arguments else "seed=0")
    assert len(commands) == 3
