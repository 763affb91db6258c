"""Modules and settings of the user's own, in the working folder, as the documents describe them."""

import os
import shutil
import subprocess
import sys
from functools import partial
from itertools import product

import pytest
from omegaconf import OmegaConf
from support import SMALL, change_json, strict_json
from written_commands import ROOT

from completesplat import compose
from completesplat.commands.new import KINDS

MINE = """
from torch import nn

class MyLoss(nn.Module):
    def forward(self, prediction, truth):
        return (prediction.images - truth.images).abs().mean()
"""
ABLATION = "# @package _global_\nloss: {terms: {ssim: null}}\n"
OWN_TERM = ["ablation=mine", "+loss.terms.mine.weight=0.1", "+loss.terms.mine.term._target_=mine.MyLoss"]
MYMETRIC = """
from pathlib import Path

Path(__file__).with_name("imported").touch()


class Bias:
    higher_is_better, heading, decimals = False, "bias", 4

    def __call__(self, predicted, true, masks):
        return ((predicted - true).mean(1, keepdim=True) * masks).mean((1, 2, 3)).abs()
"""
CHOSEN = {kind: f"fit experiment=toy_var {kind}={{}}" for kind in ("loss", "rasterizer", "ablation")}
CHOSEN |= {"metric": "test ckpt=RUN +evaluation.metrics.{0}._target_={0}.{1}"}
CHOSEN |= {"encoder": "fit experiment=toy_var autoreconstructor.encoder._target_={0}.{1}"}
CHOSEN |= {"callback": "fit experiment=toy_var +callbacks.{0}._target_={0}.{1}"}
CHOSEN |= {"dataset": "data check data={} data.root=DIR", "experiment": "fit experiment={} data.root=DATA out=RUN"}
assert set(KINDS) - {"package"} == set(CHOSEN)  # `test_extensions` begins a package
OWN_METRIC = "+evaluation.metrics.my_bias._target_=mymetric.Bias"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder with a module of the user's own and an ablation."""
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "conf/ablation").mkdir(parents=True)
    (tmp_path / "conf/ablation/mine.yaml").write_text(ABLATION)
    yield tmp_path
    sys.modules.pop("mine", None)


def test_a_loss_and_an_ablation_of_the_working_folder_are_trained_with_and_the_run_is_tested(command, own, toy_root):
    settings = [f"data.root={toy_root}", *SMALL, "callbacks.images=null", "test=false"]
    command.succeeds("fit", "experiment=toy_var", *OWN_TERM, *settings, "out=RUN")
    terms = OmegaConf.load(own / "RUN/config.yaml").loss.terms
    assert (terms.ssim, terms.mine.term._target_) == (None, "mine.MyLoss")
    assert "train/mine" in (own / "RUN/metrics.csv").read_text().splitlines()[0]
    command.succeeds("test", "ckpt=RUN/checkpoints/last.ckpt", "trainer.accelerator=cpu", "out=TEST")


def test_an_ablation_that_would_set_nothing_is_refused(command, own, toy_root):
    (own / "conf/ablation/mine.yaml").write_text(ABLATION.partition("\n")[2])
    refused = command.refuses("fit", "experiment=toy_var", "ablation=mine", f"data.root={toy_root}")
    assert refused == "ablation: its file needs `# @package _global_` as its first line, to set anything"
    (own / "conf/ablation/mine.yaml").write_text(ABLATION.replace("}}", ""))
    refused = command.refuses("fit", "experiment=toy_var", "ablation=mine", f"data.root={toy_root}")
    assert "mine.yaml" in refused
    assert "line 2" in refused


def test_a_folder_of_settings_is_added_to_those_of_the_package(command, own, toy_root):
    (own / "more/data").mkdir(parents=True)
    (own / "more/data/mine.yaml").write_text(f"defaults: [toy_objects]\nroot: {toy_root}\nimage_size: 32\n")
    command.succeeds("data", "check", "--config-dir", "more", "data=mine", "workers=1", "out=OUT")
    assert strict_json(own / "OUT/check.json")["usable"]["sequences"] == 4
    assert "nowhere' not found" in command.refuses("data", "check", "--config-dir", "nowhere", "data=mine")


def test_the_packages_settings_come_first_and_those_of_the_working_folder_are_found_by_every_verb(own, monkeypatch):
    monkeypatch.chdir(own)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (own / "conf/rasterizer").mkdir()
    (own / "conf/rasterizer/mine.yaml").write_text("_target_: mine.Mine\n")
    (own / "conf/rasterizer/reference.yaml").write_text("_target_: mine.Mine\n")
    for verb in ("fit", "test", "predict", "view"):
        assert compose(verb, "rasterizer=mine").rasterizer._target_ == "mine.Mine"
    assert compose("fit", "rasterizer=reference").rasterizer._target_.startswith("completesplat.")


STARTED = {
    "command": ["-c", "import sys; sys.argv[1:] = ['doctor', 'out=OUT']; from completesplat.cli import main; main()"],
    "module": ["-m", "completesplat", "doctor", "out=OUT"],
    "process of a launcher": ["-P", "-m", "completesplat", "doctor", "out=OUT"],
}


@pytest.mark.processes
@pytest.mark.parametrize("name", STARTED)
def test_modules_of_the_working_folder_stand_in_for_no_others(own, name):
    for module in ("rich", "torch", "hydra", "html"):
        (own / f"{module}.py").write_text("raise RuntimeError('not the one that is installed')\n")
    (own / "json.py").write_text("raise RuntimeError('not the one of the standard library')\n")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)} | ({"PYTHONSAFEPATH": "1"} if name == "command" else {})
    done = subprocess.run([sys.executable, *STARTED[name]], cwd=own, env=environment, capture_output=True, text=True)
    assert "not the one" not in done.stderr
    assert done.returncode == 0, done.stderr


@pytest.mark.processes
def test_what_is_begun_runs_as_it_is_written(command, own):
    assert all(f" {kind}" in command.succeeds("new", "--help").out for kind in KINDS)
    for kind in CHOSEN:
        *written, following, chosen = command.succeeds("new", kind, f"my_{kind}").out.splitlines()
        assert all((own / name).is_file() for name in written)
        assert following == f"next: {sys.executable} -m pytest test_{kind}_my_{kind}.py"
        assert chosen == f"then: completesplat {CHOSEN[kind].format(f'my_{kind}', f'My{kind.capitalize()}')}"
    assert not (own / "outputs").exists()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    program = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *sorted(own.glob("test_*.py"))]
    done = subprocess.run(program, cwd=own, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout
    assert "exists already" in command.refuses("new", "loss", "my_loss")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["loss"], "name is needed: give name=VALUE"),
        (["thing", "mine"], "kind=thing: choose one of loss, metric, rasterizer, encoder, callback, dataset"),
        (["loss", "a-b"], "name=a-b: must be a Python name"),
        (["loss", "json"], "name=json: a module has this name"),
        (["ablation", "full"], "name=full: the package has conf/ablation/full.yaml"),
        (["loss", "a", "b"], "give one kind and one name"),
    ],
)
def test_what_cannot_be_begun_is_refused(command, own, given, message):
    assert command.refuses("new", *given).startswith(message)
    assert {path.name for path in own.iterdir()} == {"mine.py", "conf"}


@pytest.fixture
def own_metric(own):
    (own / "mymetric.py").write_text(MYMETRIC)
    yield own
    sys.modules.pop("mymetric", None)


def test_a_metric_of_the_working_folder_stands_beside_the_others_wherever_they_do(command, own_metric, pipeline):
    test = ["test", f"ckpt={pipeline.var}", "trainer.accelerator=cpu", "logger=csv"]
    printed = command.succeeds(*test, OWN_METRIC, "out=RUNS/OWN").out
    own = strict_json(own_metric / "RUNS/OWN/metrics.json")
    plain = strict_json(pipeline.var / "metrics.json")["test"]
    stated = own["protocol"]["metrics"].pop("my_bias")
    assert stated == {"_target_": "mymetric.Bias", "style": {"heading": "bias", "better": "↓", "decimals": 4}}
    assert own["protocol"]["metrics"] == plain["protocol"]["metrics"]
    logged = (own_metric / "RUNS/OWN/metrics.csv").read_text().splitlines()[0].split(",")
    for predictor, region, view in product(plain.keys() - {"protocol"}, ("full", "object"), ("novel", "reference")):
        scores = own[predictor][region][view]
        assert 0 <= scores.pop("my_bias") < 1
        assert scores == pytest.approx(plain[predictor][region][view], rel=1e-5)
        place = "test" if predictor == "model" else f"test/{predictor}"
        assert f"{place}/{region}/{view}/my_bias" in logged
    assert "bias" in printed
    command.succeeds("report", "tables", "runs=RUNS", "out=TABLES")
    assert (own_metric / "TABLES/tables.md").read_text().count("novel views: bias ↓ |") == 2


def test_a_metric_that_a_run_names_is_not_imported(command, own_metric, pipeline, tmp_path, monkeypatch):
    """Not even if the run is the user's own: what is measured is up to who tests."""
    shutil.copytree(pipeline.var, own_metric / "RUN")
    config = OmegaConf.load(own_metric / "RUN/config.yaml")
    config.evaluation.metrics = {"psnr": {"_target_": "mymetric.Bias"}}
    more = [OWN_METRIC, "evaluation.metrics.ssim=null"]
    change_json(own_metric / "RUN/run.json", lambda record: record["overrides"].extend(more))
    OmegaConf.save(config, own_metric / "RUN/config.yaml")
    printed = command.succeeds("test", "ckpt=RUN", "trainer.accelerator=cpu", "out=OUT").out
    assert not (own_metric / "imported").exists()
    assert f"metrics of the run are left out; give them again: {OWN_METRIC}\n" in printed
    config.model.metric = {"_target_": "mymetric.Bias"}
    OmegaConf.save(config, own_metric / "RUN/config.yaml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.syspath_prepend(own_metric)
    assert "names mymetric.Bias, which is no part" in command.refuses("test", f"ckpt={own_metric / 'RUN'}", "out=OUT")
    assert not (own_metric / "imported").exists()


@pytest.mark.slow
def test_an_installed_wheel_does_what_the_documents_say_in_every_process(installed, own, toy_root):
    """Two training processes, worker processes that load data, and a job in a process of submitit's."""
    run = partial(installed.run, own, "completesplat")
    run("new", "dataset", "images")
    installed.run(own, "python", "-c", "import test_dataset_images as t; t.write('DATA')")
    images = ["data=images", "data.root=DATA", "data.image_size=32"]
    run("data", "check", *images, "workers=2", "out=CHECK")
    quick = ["callbacks.images=null", "test=false"]
    own_fit = ["experiment=toy_var", *OWN_TERM, f"data.root={toy_root}", *SMALL, *quick]
    processes = ["trainer.devices=2", "trainer.strategy=ddp", "rasterizer=reference", "data.workers=1"]
    run("fit", *own_fit, *processes, "out=RUN")
    run("fit", "-m", *own_fit, "seed=0,1", "out=SWEEP")
    run("fit", "-m", *own_fit, "seed=choice(0)", "hydra/launcher=submitit_local", "out=JOBS")
    for job in ("RUN", "SWEEP/seed-0", "SWEEP/seed-1", "JOBS/seed-0"):
        assert strict_json(own / job / "metrics.json")["steps"] == 2
        assert (own / job / "run.json").is_file()
