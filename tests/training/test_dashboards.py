"""What a training leaves for dashboards: W&B's offline file, TensorBoard's events and `metrics.csv`, read back."""

import json
from pathlib import Path

import pytest
from small_runs import rows
from support import SMALL, call
from wandb_files import offline_runs

import completesplat
from completesplat.commands.evaluate import built_parts

pytestmark = pytest.mark.processes
GIVEN = ["experiment=toy_var", "ablation=no_ssim", *SMALL, "trainer.log_every_n_steps=1", "test=false"]
WANDB = ["wandb.tags=[toys,first]", "wandb.notes=to see it", "wandb.log_model=true"]


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


def test_wandb_has_rate_gradients_validation_and_the_weights(out):
    (run,) = offline_runs(out)
    values = run.merged()
    assert {"train/learning_rate", "train/gradient_norm", "val/psnr_novel"} <= values.keys()
    kept = [record for record in run.records if record.WhichOneof("record_type") == "request"]
    kept = [record.request.log_artifact.artifact for record in kept if record.request.HasField("log_artifact")]
    kept += [record.artifact for record in run.records if record.WhichOneof("record_type") == "artifact"]
    (artifact,) = kept
    assert artifact.type == "model"
    names = {entry.path for entry in artifact.manifest.contents}
    assert {"config.json", "model.safetensors"} <= names
    assert "val/psnr_novel" in json.loads(artifact.metadata)


def test_tensorboard_has_the_same_figures_and_images(out):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(out / "tensorboard"))
    events.Reload()
    tags = events.Tags()
    numbers = {name for row in rows(out) for name, value in row.items() if value} - {"step"}
    assert {"train/loss", "train/learning_rate", "train/gradient_norm"} <= numbers <= {*tags["scalars"]}
    assert tags["images"] == ["images"]


def test_the_rate_is_that_of_the_schedule(out):
    rates = [float(row["train/learning_rate"]) for row in rows(out) if row["train/learning_rate"]]
    config = completesplat.compose("fit", *GIVEN)
    assert rates
    assert 0 < max(rates) <= config.optimizer.lr
    assert all(float(row["train/gradient_norm"]) > 0 for row in rows(out) if row["train/gradient_norm"])


def test_a_run_goes_without_loggers_and_callbacks(command, pipeline, tmp_path):
    given = ["logger=null", "callbacks=null", "trainer=cpu", f"data.root={pipeline.toy}", f"out={tmp_path / 'run'}"]
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
