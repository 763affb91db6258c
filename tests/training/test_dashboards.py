"""What a training leaves for dashboards: W&B's offline file, TensorBoard's events and `metrics.csv`, read back."""

import io
import json
from pathlib import Path

import imageio.v2 as imageio
import pytest
from PIL import Image
from small_runs import rows
from support import SMALL, call
from wandb_files import offline_runs

import completesplat
from completesplat.commands.evaluate import built_parts
from completesplat.training.fixed_scenes import TURN_FRAMES

pytestmark = pytest.mark.processes
GIVEN = ["experiment=toy_var", "ablation=no_ssim", *SMALL, "trainer.log_every_n_steps=1"]
WANDB = ["wandb.tags=[toys,first]", "wandb.notes=to see it", "wandb.log_model=true"]
FIGURES = {"train/loss", "train/learning_rate", "train/gradient_norm", "val/loss", "val/psnr_novel"}
SCORE = "test/full/novel/psnr"


@pytest.fixture(scope="module")
def out(pipeline, tmp_path_factory) -> Path:
    """Folder of a run with all three loggers."""
    pytest.importorskip("wandb")
    pytest.importorskip("tensorboard")
    out = tmp_path_factory.mktemp("dashboards") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.delenv("WANDB_MODE", raising=False)
        monkeypatch.chdir(out.parent)
        loggers = ["logger=[wandb,tensorboard]", *WANDB]
        assert call(monkeypatch, "fit", *GIVEN, f"data.root={pipeline.toy}", *loggers, f"out={out}") == 0
    return out


def config_of(run) -> dict:
    """The config of an offline run, by key."""
    updates = [run.only("run").config.update]
    updates += [record.config.update for record in run.records if record.WhichOneof("record_type") == "config"]
    return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for each in updates for item in each}


def test_wandb_knows_what_was_asked_for(out):
    (run,) = offline_runs(out)
    config = config_of(run)
    assert config["options"]["ablation"] == "no_ssim"
    assert config["options"]["experiment"] == "toy_var"
    assert config["command"].startswith("completesplat fit experiment=toy_var ablation=no_ssim")
    assert config["commit"] == json.loads((out / "run.json").read_text())["commit"]
    assert config["trainer"]["log_every_n_steps"] == 1
    told = run.only("run")
    assert (list(told.tags), told.notes, told.job_type) == (["toys", "first"], "to see it", "fit")


def test_wandb_has_rate_gradients_validation_and_the_weights_with_their_scores(out):
    (run,) = offline_runs(out)
    assert run.merged().keys() >= FIGURES
    kept = [record for record in run.records if record.WhichOneof("record_type") == "request"]
    kept = [record.request.log_artifact.artifact for record in kept if record.request.HasField("log_artifact")]
    kept += [record.artifact for record in run.records if record.WhichOneof("record_type") == "artifact"]
    (artifact,) = kept
    assert artifact.type == "model"
    names = {entry.path for entry in artifact.manifest.contents}
    assert {"config.json", "model.safetensors"} <= names
    scores = json.loads((out / "metrics.json").read_text())
    described = json.loads(artifact.metadata)
    assert described[SCORE] == scores[SCORE] == scores["test"]["model"]["full"]["novel"]["psnr"]
    assert described["val/loss"] == scores["val/loss"]


def test_wandb_shows_the_fixed_scenes_and_a_scene_that_turns(out):
    (run,) = offline_runs(out)
    values = run.merged()
    sheet = Image.open(run.folder / "files" / values["images/path"])
    assert sheet.size == Image.open(out / "images/step_000002.png").size
    assert values["turn/_type"] == "video-file"
    frames = imageio.mimread(run.folder / "files" / values["turn/path"], memtest=False)
    assert (len(frames), frames[0].shape) == (TURN_FRAMES, (256, 256, 3))


def test_the_test_of_a_checkpoint_is_a_run_of_its_own_kind(out, monkeypatch, tmp_path):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.chdir(tmp_path)
    given = [f"ckpt={out / 'checkpoints/last.ckpt'}", "logger=wandb", "trainer.accelerator=cpu", "out=SCORES"]
    assert call(monkeypatch, "test", *given) == 0
    (run,) = offline_runs(tmp_path / "SCORES")
    assert run.only("run").job_type == "test"
    assert SCORE in run.merged()


def test_tensorboard_has_the_same_figures_and_images(out):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(out / "tensorboard"))
    events.Reload()
    tags = events.Tags()
    numbers = {name for row in rows(out) for name, value in row.items() if value} - {"step"}
    assert FIGURES | {SCORE} <= numbers <= {*tags["scalars"]}
    assert tags["images"] == ["images"]
    (drawn,) = events.Images("images")
    sheet = Image.open(out / "images/step_000002.png")
    assert Image.open(io.BytesIO(drawn.encoded_image_string)).tobytes() == sheet.tobytes()


def test_the_rate_is_that_of_the_schedule(out):
    rates = [float(row["train/learning_rate"]) for row in rows(out) if row["train/learning_rate"]]
    config = completesplat.compose("fit", *GIVEN)
    assert rates
    assert 0 < max(rates) <= config.optimizer.lr
    assert all(float(row["train/gradient_norm"]) > 0 for row in rows(out) if row["train/gradient_norm"])


def test_a_run_goes_without_loggers_and_callbacks(command, pipeline, tmp_path):
    given = ["logger=null", "callbacks=null", "trainer=cpu", f"data.root={pipeline.toy}", f"out={tmp_path / 'run'}"]
    given += ["test=false", "debug=null", "hparams_search=null"]
    assert command("fit", *[word for word in GIVEN if not word.startswith("callbacks")], *given).status == 0
    assert not (tmp_path / "run/metrics.csv").exists()
    assert (tmp_path / "run/weights/model.safetensors").is_file()


@pytest.mark.parametrize(("group", "option"), [("logger", "null"), ("logger", "[]"), ("callbacks", "null")])
@pytest.mark.parametrize("experiment", ["toy_var", "toy_diffusion"])
def test_groups_are_left_out(group, option, experiment):
    config = completesplat.compose("fit", f"experiment={experiment}", f"{group}={option}")
    assert built_parts(config.get(group)) == []


@pytest.mark.parametrize("name", ["cpu", "gpu", "mps"])
def test_trainers_of_one_device(name):
    assert completesplat.compose("fit", f"trainer={name}").trainer.accelerator == name
