"""What the configuration of a run may name: it may come from a stranger."""

import os
import re
import sys

import pytest
import torch
from hydra.utils import get_object
from omegaconf import OmegaConf
from support import compose_config

from completesplat.commands import conf_folder
from completesplat.commands.jobs import use_working_folder
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.settings.checks import START_WEIGHTS
from completesplat.settings.schema import arguments_of
from completesplat.weights.allowed import GROUPS_OF_RUNS, GROUPS_OF_WEIGHTS, listed_parts
from completesplat.weights.runs import config_of_run

GROUPS = {*GROUPS_OF_RUNS, *GROUPS_OF_WEIGHTS}

MINE = """
import json
from torch import load
class Mine:
    pass
def make(**settings):
    return Mine()
"""


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.fixture
def run(tmp_path):
    """A run's folder, with a checkpoint that is never read."""
    folder = tmp_path / "runs/run"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints/last.ckpt").touch()
    config = compose_config("fit", "experiment=toy_var", "data.root=DATA", "out=OUT")
    resolved = {name: OmegaConf.to_container(config[name], resolve=True) for name in ("model", "data")}
    OmegaConf.save(resolved, folder / "config.yaml")
    return folder


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A folder of the user's own modules."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules/mine.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    yield
    sys.modules.pop("mine", None)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "elsewhere"


def name(run, value, place="model.rasterizer"):
    config = OmegaConf.load(run / "config.yaml")
    OmegaConf.update(config, place, value, merge=False, force_add=True)
    OmegaConf.save(config, run / "config.yaml")


def configuration(run, *overrides, trust=False):
    return config_of_run(run / "checkpoints/last.ckpt", list(overrides), trust)


FOREIGN = [
    {"_target_": "torch.load", "f": "PAYLOAD", "weights_only": False},
    {"_target_": "os.system", "command": "touch SPRUNG"},
    {"_target_": "builtins.eval", "_args_": ["open('SPRUNG', 'w')"]},
    {"_target_": "torch.optim.adam.torch.load", "f": "PAYLOAD", "weights_only": False},
    {"_target_": "torch.optim.Adam.__init__.__globals__"},
    {"_target_": "completesplat.commands.launch", "verb": "test", "arguments": []},
    {"_target_": "completesplat.losses.terms.torch.load", "f": "PAYLOAD", "weights_only": False},
    {"_target_": "missing_module.Thing"},
    {"_target_": ""},
    {"_target_": ["os.system"]},
    {"_target_": "torch.optim.Adam", "_args_": [[{"_target_": "os.system", "command": "touch SPRUNG"}]]},
    {"_target_": "mine.load", "f": "PAYLOAD", "weights_only": False},
    {"_target_": "mine.json.loads", "s": "{}"},
    {"_target_": "mine.make.__globals__.get"},
]


@pytest.mark.usefixtures("mine", "elsewhere")
@pytest.mark.parametrize("foreign", FOREIGN, ids=lambda foreign: str(foreign["_target_"]))
def test_what_is_neither_the_packages_nor_the_users_is_refused_always(run, tmp_path, monkeypatch, foreign):
    torch.save(Payload(tmp_path / "sprung"), tmp_path / "payload")
    text = OmegaConf.to_yaml(foreign).replace("PAYLOAD", str(tmp_path / "payload"))
    name(run, OmegaConf.create(text.replace("SPRUNG", str(tmp_path / "sprung"))), "model.rasterizer")
    for trust in (False, True):
        with pytest.raises(WeightsError, match=r"config\.yaml names |cannot be imported"):
            configuration(run, trust=trust)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WeightsError, match=r"not defined in a module of your own|cannot be imported"):
        configuration(run)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.usefixtures("mine", "elsewhere")
@pytest.mark.parametrize("target", ["mine.Mine", "mine.make"])
def test_modules_of_the_users_own_are_named_where_the_run_is_the_users_or_trusted(run, tmp_path, monkeypatch, target):
    name(run, {"_target_": target})
    with pytest.raises(WeightsError, match=rf"config\.yaml names {target}, .* trust=true"):
        configuration(run)
    assert "mine" not in sys.modules
    assert configuration(run, trust=True).model.rasterizer._target_ == target
    monkeypatch.chdir(tmp_path)
    assert configuration(run).model.rasterizer._target_ == target
    monkeypatch.setattr(os, "getuid", lambda: os.stat(run).st_uid + 1)
    with pytest.raises(WeightsError, match="trust=true"):
        configuration(run)


def test_modules_of_the_working_folder_are_the_users_own_and_a_strangers_run_is_not_trusted_for_them(
    run, elsewhere, tmp_path, monkeypatch
):
    """Neither where it lies elsewhere, nor where somebody works in its folder, beside modules that came with it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    name(run, {"_target_": "owned.Owned"})
    for folder in (elsewhere, run, tmp_path):
        (folder / "owned.py").write_text("class Owned: pass\nopen('sprung', 'w')\n")
    for folder in (elsewhere, run):
        monkeypatch.chdir(folder)
        use_working_folder()
        with pytest.raises(WeightsError, match=r"names owned\.Owned, .* trust=true"):
            configuration(run)
        assert not (folder / "sprung").exists()
        sys.path.remove(str(folder))
    monkeypatch.chdir(tmp_path)
    use_working_folder()
    assert configuration(run).model.rasterizer._target_ == "owned.Owned"
    assert (tmp_path / "sprung").exists()
    sys.modules.pop("owned")


def test_settings_of_the_working_folder_do_not_widen_what_a_run_may_name(run, tmp_path, monkeypatch):
    (tmp_path / "conf/rasterizer").mkdir(parents=True)
    (tmp_path / "conf/rasterizer/mine.yaml").write_text("_target_: os.system\n")
    monkeypatch.chdir(tmp_path)
    name(run, {"_target_": "os.system", "command": "true"})
    with pytest.raises(WeightsError, match="not defined in a module of your own"):
        configuration(run)


def test_parts_that_have_moved_are_found_by_their_names(run, elsewhere):
    """Other versions had them in other modules. A name that is no part stays refused."""
    before = configuration(run)
    name(run, before.model._target_.replace("training.", "moved.by."), "model._target_")
    name(run, "completesplat.moved.Encoder", "model.model.encoder._target_")
    assert configuration(run) == before
    for target in ("completesplat.moved.launch", "moved.Encoder"):
        name(run, target, "model.model.encoder._target_")
        with pytest.raises(WeightsError, match=f"names {target}, "):
            configuration(run)
    targets = {path for group in GROUPS for file in (conf_folder() / group).glob("*.yaml") for path in named_in(file)}
    assert {part.path for part in listed_parts().values()} == targets
    assert len(listed_parts()) == len(targets) > 40


def named_in(file):
    return re.findall(r"_target_: (\w[\w.]+)", file.read_text())


def test_settings_of_weights_to_start_from_have_the_same_names_in_all_parts():
    settings = set()
    for kind in {get_object(path) for file in conf_folder().glob("*/*.yaml") for path in named_in(file)}:
        settings |= {name for name in arguments_of(kind)[0] if name == "pretrained" or name.endswith("checkpoint")}
    assert settings == START_WEIGHTS.keys()


def test_what_the_user_changes_may_name_anything_and_what_the_package_offers_needs_no_trust(run, elsewhere):
    result = configuration(run, "model.rasterizer._target_=anything.At", "data.root=${oc.env:HOME}")
    assert result.model.rasterizer._target_ == "anything.At"
    assert result.data.root == os.environ["HOME"]
    name(run, {"_target_": "torch.optim.SGD", "_partial_": True, "lr": 0.1}, "model.optimizer")
    assert configuration(run).model.optimizer.lr == 0.1
    with_targets = {path.parent.name for path in conf_folder().glob("*/*.yaml") if "_target_: " in path.read_text()}
    others = {"callbacks", "debug", "evaluation", "logger", "trainer"}
    assert {one for one in with_targets - others if not one.endswith("_task")} <= GROUPS


def test_changes_are_held_to_what_fit_takes(run):
    for change, message in (
        ("data.batch_size=-1", "data.batch_size=-1: must be at least 1"),
        ("data.rot=x", "ToyObjectsDataModule has no setting rot (data.rot); did you mean root?"),
        ("model.background=2", "model.background=2: must lie between 0 and 1"),
        ("model.optimizer.adam_betas=[2,2]", "optimizer: "),
        ("data.image_size=50", "data.image_size=50: must be a multiple of 8 "),
        ("seed=3", "seed: no setting of a run's model or data"),
    ):
        with pytest.raises(CompleteSplatError, match=re.escape(message)):
            configuration(run, change)


def test_resolvers_and_references_and_what_is_no_configuration_are_refused(run):
    for value in ("${oc.env:HOME}", "a ${x}"):
        name(run, value, "model.background")
        with pytest.raises(WeightsError, match=re.escape(f"{value} refers to something else")):
            configuration(run, trust=True)
    for text in ("", "[1]", "model: 3", "{", "!!python/object/apply:os.getcwd []"):
        (run / "config.yaml").write_text(text)
        with pytest.raises(WeightsError, match=r"config\.yaml: not "):
            configuration(run)


@pytest.mark.parametrize("verb", ["test", "report controls", "data latents"])
def test_no_verb_runs_what_a_run_names(command, run, elsewhere, monkeypatch, tmp_path, verb):
    monkeypatch.chdir(elsewhere)  # `command` works in the folder that holds the run
    torch.save(Payload(tmp_path / "sprung"), tmp_path / "payload")
    for place in ("model.rasterizer", "model.model.encoder"):
        name(run, {"_target_": "torch.load", "f": str(tmp_path / "payload"), "weights_only": False}, place)
    finished = command(*verb.split(), f"ckpt={run}/checkpoints/last.ckpt")
    assert not (tmp_path / "sprung").exists()
    assert finished.status == 2
    assert finished.err.splitlines()[-1].startswith(f"error: {run}/config.yaml names torch.load, ")
