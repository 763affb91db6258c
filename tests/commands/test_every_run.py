"""Runs of every kind of model: their folders, weights and checkpoints give scenes, or say why not."""

import copy
import json
import shutil
import sys
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from PIL import Image
from support import SMALL, compose_config, strict_json

from completesplat.commands.trained import RunCheckpoint
from completesplat.commands.view import setting_of_path
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.export.ply import read_ply
from completesplat.generator import CompleteSplat, DeterministicModel
from completesplat.weights import CONFIG_FILE, SUMS_FILE

QUICK = [*SMALL, "callbacks.images=null"]


@pytest.fixture(scope="module")
def splatter(pipeline, built_once):
    """A run of the baseline Splatter Image."""
    from conftest import made

    given = ["fit", "experiment=toy_var", "model=splatter_image", f"data.root={pipeline.toy}", *QUICK, "test=false"]
    return built_once("splatter", lambda folder: made(folder / "run", *given, "regressor.channels=[8,16,16]")) / "run"


@pytest.fixture
def run(pipeline, request):
    return getattr(pipeline, request.param, None) or request.getfixturevalue("splatter")


@pytest.mark.parametrize(("run", "samples"), [("var", 1), ("splatter", 1), ("diffusion", 2)], indirect=["run"])
def test_a_runs_folder_its_weights_and_its_checkpoint_give_the_same_scenes(pipeline, run, samples):
    scenes = []
    for weights in (run, run / "weights", run / "checkpoints/last.ckpt"):
        scenes.append(CompleteSplat.from_pretrained(weights)(pipeline.photograph(), samples=samples))
        assert setting_of_path(weights) == {"weights": str(run / "weights" if weights.is_dir() else weights)}
    for others in scenes[1:]:
        for scene, other in zip(scenes[0], others, strict=True):
            assert all(torch.equal(value, getattr(other, name)) for name, value in vars(scene).items())


@pytest.mark.parametrize("run", ["var", "splatter"], indirect=True)
def test_scenes_of_stage_one_are_those_that_its_test_scores(pipeline, run):
    model = CompleteSplat.from_pretrained(run)
    assert isinstance(model, DeterministicModel)
    assert not model.draws_samples
    checkpoint = run / "checkpoints/last.ckpt"
    module, data = RunCheckpoint(
        checkpoint, [f"data.root={pipeline.toy}"], trust=True, sampler=None, seed=0, method=None
    ).open()
    data.setup("test")
    batch = next(iter(data.test_dataloader()))
    with torch.no_grad():
        expected = module.eval().reconstruct(batch)
        result = model.generate(batch.reference.images, batch.reference.cameras, batch.depth_range)
    for name, values in vars(expected).items():
        torch.testing.assert_close(getattr(result, name), values)
    camera = data.typical_camera()
    assert model.fov_degrees.item() == pytest.approx(camera.fov_degrees)
    assert model.depth_range.tolist() == pytest.approx(camera.depth_range)
    assert model.up.tolist() == pytest.approx(camera.up)
    with pytest.raises(CompleteSplatError, match="samples=2: this model draws none, it gives one answer"):
        model(pipeline.photograph(), samples=2)


def test_hidden_pixels_have_no_influence_on_stage_one(pipeline):
    model = CompleteSplat.from_pretrained(pipeline.var)
    photograph = model.read(pipeline.photograph())
    visible = torch.ones(1, 32, 32)
    visible[..., 16:] = 0
    changed = copy.deepcopy(photograph)
    changed.image[..., 16:] = 0.3
    assert torch.equal(model(photograph, visible)[0].means, model(changed, visible)[0].means)
    assert not torch.equal(model(photograph)[0].means, model(changed)[0].means)


def test_a_run_of_fitted_scenes_leaves_them_and_says_so_when_a_photograph_is_given(command, pipeline, tmp_path):
    fitting = ["model=per_scene", "model.fitting.count=300", "model.fitting.steps=3"]
    run = tmp_path / "run"
    used = [setting for setting in QUICK if not setting.startswith(("trainer.max_", "trainer.val_check"))]
    settings = [f"data.root={pipeline.toy}", *used, *fitting, f"out={run}"]
    command.succeeds("fit", "experiment=toy_var", *settings)
    (folder,) = (run / "scenes").iterdir()
    assert {path.name for path in folder.iterdir()} == {"scene.ply", "sheet.png", "scene.json"}
    assert 0 < read_ply(folder / "scene.ply").count <= 300
    Image.open(folder / "sheet.png").verify()
    assert strict_json(folder / "scene.json")["settings"]["scene"] in folder.name
    assert setting_of_path(run) == {"scene": str(run)}
    refused = command.refuses("predict", f"image={pipeline.photograph()}", f"weights={run}", "out=out")
    assert "PerScene" in refused
    assert f"{run / 'scenes'}" in refused


@pytest.fixture
def strangers(pipeline, tmp_path):
    """A copy of stage 1's run without weights."""
    shutil.copytree(pipeline.var, tmp_path / "run", ignore=shutil.ignore_patterns("weights", "images"))
    return tmp_path / "run"


@pytest.mark.parametrize("place", ["model.model.encoder", "model.model.encoder.channels", "model"])
def test_a_checkpoint_names_nothing_but_parts_of_a_model(strangers, tmp_path, monkeypatch, place):
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')\nclass Trap: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    config = OmegaConf.load(strangers / "config.yaml")
    OmegaConf.update(config, place, {"_target_": "trap.Trap"}, merge=False)
    OmegaConf.save(config, strangers / "config.yaml")
    for path in (strangers, strangers / "checkpoints/last.ckpt"):
        with pytest.raises(WeightsError, match=r"names trap\.Trap"):
            CompleteSplat.from_pretrained(path)
    assert not (tmp_path / "sprung").exists()
    assert "trap" not in sys.modules


def test_a_checkpoint_of_another_architecture_or_without_its_camera_is_refused(strangers):
    config = OmegaConf.load(strangers / "config.yaml")
    config.model.model.encoder.latent_channels = 512
    OmegaConf.save(config, strangers / "config.yaml")
    with pytest.raises(WeightsError, match=r"network\.encoder.*in last.ckpt and .* by config.yaml"):
        CompleteSplat.from_pretrained(strangers)
    (strangers / "config.yaml").unlink()
    with pytest.raises(WeightsError, match=r"configuration .* is missing"):
        CompleteSplat.from_pretrained(strangers / "checkpoints/last.ckpt")


def test_weights_of_one_answer_name_nothing_foreign(pipeline, tmp_path):
    shutil.copytree(pipeline.var / "weights", tmp_path / "weights")
    (tmp_path / "weights" / SUMS_FILE).unlink()
    written = json.loads((tmp_path / "weights" / CONFIG_FILE).read_text())
    for changed in ({"network": {"_target_": "os.system"}}, {"more": 1}, {"image_size": 10**6}):
        (tmp_path / "weights" / CONFIG_FILE).write_text(json.dumps(written | changed))
        with pytest.raises(WeightsError, match=CONFIG_FILE):
            CompleteSplat.from_pretrained(tmp_path / "weights")


def test_a_network_that_weights_may_not_name_is_trained_and_not_exported(tmp_path, caplog, monkeypatch):
    config = compose_config("fit", "experiment=toy_var", *SMALL, "out=RUN")
    module = instantiate(config.model, _convert_="all")
    monkeypatch.setattr(type(module), "data", SimpleNamespace(image_size=32))
    module.config = {"model": {"model": {"_target_": "torch.nn.Identity"}}}
    module.save_weights(tmp_path / "weights")
    assert not (tmp_path / "weights").exists()
    assert "torch.nn.Identity" in caplog.text
