"""A run that was interrupted and continued is the run that never was: the same bits, the same rows."""

from functools import cache

import pandas
import pytest
import torch
from support import SMALL, call, interrupted_at, strict_json
from torch import Tensor

from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule

STEPS = 6
SETTINGS = [*SMALL, f"trainer.max_steps={STEPS}", "trainer.log_every_n_steps=1", "data.references_per_sequence=4"]
SETTINGS += ["callbacks.images.every_n_steps=2", "test=false", "data.batch_size=2"]
PLACES_OF_WEIGHTS = ("state_dict", "current_model_state", "averaging_state", "optimizer_states", "lr_schedulers")


@pytest.fixture(scope="module")
def settings(pipeline, latent_cache):
    """Arguments of `completesplat`, by stage; "latent_cache" is stage 2 from the latent cache."""
    stage1 = f"model.autoreconstructor_checkpoint={pipeline.var / 'checkpoints/last.ckpt'}"
    shared = [f"data.root={pipeline.toy}", *SETTINGS]
    own = [stage1, "sampler.steps=2", "callbacks.samples.every_n_steps=2"]
    stage2 = ["fit", "experiment=toy_diffusion", *shared, *own]
    cached = [*stage2, f"data.latent_cache={latent_cache}"]
    return {"var": ["fit", "experiment=toy_var", *shared], "diffusion": stage2, "latent_cache": cached}


@pytest.fixture(scope="module")
def whole(settings, tmp_path_factory):
    """The run directory of a stage's uninterrupted run, made when it is asked for."""
    runs = tmp_path_factory.mktemp("whole")

    @cache
    def run(stage):
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.chdir(runs)
            assert call(monkeypatch, *settings[stage], f"out={runs / stage}") == 0
        return runs / stage

    return run


def tensors(contents, name="") -> dict:
    """All values of nested containers, by path."""
    if isinstance(contents, dict | list):
        pairs = contents.items() if isinstance(contents, dict) else enumerate(contents)
        return {k: v for key, value in pairs for k, v in tensors(value, f"{name}/{key}").items()}
    return {name: contents}


def weights(run) -> dict:
    checkpoint = torch.load(run / "checkpoints/last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == STEPS
    return tensors({place: checkpoint[place] for place in PLACES_OF_WEIGHTS if place in checkpoint})


def rows(run) -> pandas.DataFrame:
    table = pandas.read_csv(run / "metrics.csv")
    return table[[column for column in table if not column.startswith(("speed/", "memory/"))]]


@pytest.mark.parametrize(
    ("stage", "module", "saved"),
    [
        ("var", ReconstructionModule, 3),
        pytest.param("var", ReconstructionModule, 4, marks=pytest.mark.slow),
        pytest.param("diffusion", LatentDiffusion, 3, marks=pytest.mark.slow),
        pytest.param("latent_cache", LatentDiffusion, 3, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_is_continued_is_bit_equal(settings, whole, tmp_path, monkeypatch, stage, module, saved):
    monkeypatch.chdir(tmp_path)
    arguments = [*settings[stage], f"callbacks.checkpoint.every_n_train_steps={saved}", f"out={tmp_path}/run"]
    with interrupted_at(saved + 1, module):
        assert call(monkeypatch, *arguments) != 0
    assert rows(tmp_path / "run")["step"].max() == saved  # So it did more than it saved.
    assert call(monkeypatch, *arguments, "ckpt_path=last") == 0
    must_be_equal(whole(stage), tmp_path / "run")
    assert any("current_model_state" in name for name in weights(tmp_path / "run")) == (stage != "var")


@pytest.mark.slow
def test_a_finished_run_whose_end_moves_is_the_run_that_had_this_end_from_the_start(settings, whole, tmp_path, command):
    """The first end is a multiple of the images' interval, because images are also drawn at the end."""
    run = tmp_path / "run"
    first = [*settings["var"], "trainer.max_steps=4", f"out={run}"]
    command.succeeds(*first)
    refused = command.refuses(*settings["var"], "optimizer.lr=1", f"out={run}", "ckpt_path=last")
    assert f"{run} holds a run with another optimizer.lr: give all settings of {run}/run.json again" in refused
    assert ", or continue in another folder: completesplat fit " in refused
    assert refused.endswith(f" ckpt_path={run}/checkpoints/last.ckpt out=MORE")
    command.succeeds(*settings["var"], f"out={run}", "ckpt_path=last")
    must_be_equal(whole("var"), run)
    record = strict_json(run / "run.json")
    (earlier,) = record["earlier_ends"]
    assert (earlier["trainer.max_steps"], earlier["command"]) == (4, ["completesplat fit", *first[1:]])
    assert f"trainer.max_steps={STEPS}" in record["command"]
    assert strict_json(run / "metrics_4_steps.json")["steps"] == 4
    again = [command(*settings["var"], f"out={run}", "ckpt_path=last", *more) for more in ([], ["trainer.max_steps=5"])]
    assert "finished before" in again[0].out
    assert again[1].err.startswith(f"error: trainer.max_steps=5: {run} has {STEPS} steps; give more")


def must_be_equal(whole, result) -> None:
    """Weights, the rows of `metrics.csv` and the figures in `metrics.json`."""
    expected = weights(whole)
    continued = weights(result)
    assert expected.keys() == continued.keys()
    same = {name: value == continued[name] for name, value in expected.items()}
    assert [name for name, equal in same.items() if not (equal.all() if isinstance(equal, Tensor) else equal)] == []
    pandas.testing.assert_frame_equal(rows(whole), rows(result), check_exact=True)
    assert results(whole) == results(result)


def results(run) -> dict:
    return {k: v for k, v in strict_json(run / "metrics.json").items() if not k.startswith(("speed/", "memory/"))}


@pytest.mark.slow
def test_drawing_images_and_samples_does_not_change_training(settings, whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for stage, drawn in {"var": ["images"], "diffusion": ["images", "samples"]}.items():
        kept = [setting for setting in settings[stage] if not setting.startswith(("callbacks.im", "callbacks.sam"))]
        off = [f"callbacks.{name}=null" for name in drawn]
        assert call(monkeypatch, *kept, *off, f"out={tmp_path / stage}") == 0
        expected, result = (weights(run) for run in (whole(stage), tmp_path / stage))
        assert all(torch.equal(v, result[k]) for k, v in expected.items() if isinstance(v, Tensor))
        for name in drawn:
            assert not (tmp_path / stage / name).exists()
            images = sorted(path.name for path in (whole(stage) / name).glob("step_*"))
            assert images == [f"step_00000{n}.png" for n in (2, 4, 6)]
