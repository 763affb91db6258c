"""Sweeps: a folder for each job, which continues, or tells sweepers that look for good settings a figure."""

import csv
import json
import math
import os
import stat
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from hydra.errors import MissingConfigException
from hydra.types import RunMode
from omegaconf import OmegaConf
from support import LIMIT, SMALL, call, script, strict_json
from vgg_weights import blank, saved

from completesplat.commands import jobs
from completesplat.commands.continuing import is_finished
from completesplat.commands.jobs import optimized
from completesplat.errors import CompleteSplatError, DivergenceError
from completesplat.losses.lpips import load_vgg16
from completesplat.settings.composition import LONGEST_NAME, job_name, nearest_names, shard_folder, swept_keys
from completesplat.settings.sweeps import starts_search

LAST = "checkpoints/last.ckpt"


def root_with(*overrides: str):
    return OmegaConf.create({"hydra": {"overrides": {"task": list(overrides)}}})


def settings(root: Path) -> list[str]:
    given = [f"data.root={root}", *SMALL, "trainer.max_steps=1", "callbacks.images=null", "test=false"]
    return ["fit", "-m", "experiment=toy_var", *given]


def weights(job: Path) -> dict[str, torch.Tensor]:
    return torch.load(job / LAST, weights_only=True)["state_dict"]


def test_a_job_is_named_by_what_is_swept_plainly_and_like_no_other():
    root = root_with("experiment=toy_var", "ablation=no_skips", "seed=1", "data.root=/a/b")
    assert job_name("ablation", "seed", _root_=root) == "ablation-no_skips+seed-1"
    assert len(job_name("name", _root_=root_with(f"name={'写' * 105}")).encode()) <= LONGEST_NAME
    assert job_name("optimizer.lr", _root_=root_with("+optimizer.lr=1e-3")) == "optimizer.lr-1e-3"
    search = OmegaConf.merge(root, {"hydra": {"sweeper": {"params": {"ablation": "choice(a)", "unused": "choice(1)"}}}})
    assert job_name("seed", _root_=search) == "seed-1+ablation-no_skips"
    shards = OmegaConf.merge(root_with("shard=1", "shards=2", "seed=3"), {"shard": 1, "shards": 2})
    assert job_name("shard", "seed", _root_=shards) + shard_folder(shards) == "seed-3/shard-1"
    assert job_name("shard", _root_=shards) + shard_folder(shards) == "./shard-1"
    assert job_name("seed", _root_=root) + shard_folder(root) == "seed-1"
    names = {job_name("data.root", _root_=root_with(f"data.root={path}")) for path in ("/a/b", "/a_b", "a/b", "ab")}
    names |= {job_name("x", _root_=root_with(f"x={'y' * 300}{end}")) for end in "ab"}
    assert len(names) == 6
    assert all(not set(name) & set("/=,") and len(name) < LONGEST_NAME + 12 for name in names)
    given = ["-m", "experiment=toy_var", "ablation=glob(*)", "seed=0,1", "levels=[0,1]", "x=range(3)", "y=choice(1)"]
    assert swept_keys(given) == ["ablation", "seed", "x", "y"]
    assert starts_search(["hparams_search=optuna"])
    assert not starts_search(["~hparams_search", "experiment=toy_var"])


@pytest.fixture(scope="module")
def whole(toy_root, tmp_path_factory) -> Path:
    """A sweep of one job that ran through."""
    sweep = tmp_path_factory.mktemp("sweeps") / "whole"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert call(monkeypatch, *settings(toy_root), "seed=choice(0)", f"out={sweep}") == 0
    return sweep


def test_a_sweep_that_is_started_again_repeats_no_finished_job(command, toy_root, whole):
    jobs = [whole / "seed-0", whole / "seed-1"]
    record = strict_json(jobs[0] / "run.json")
    assert (record["verb"], record["groups"]["experiment"]) == ("fit", "toy_var")
    assert record["sweep"] == {"folder": "..", "job": 0}
    before = (jobs[0] / LAST).stat().st_mtime_ns
    again = command.succeeds(*settings(toy_root), "seed=0,1", f"out={whole}")
    assert again.out.count("finished before, not repeated") == 1
    assert (jobs[0] / LAST).stat().st_mtime_ns == before
    assert (jobs[1] / "metrics.json").is_file()
    assert any(not torch.equal(value, weights(jobs[1])[name]) for name, value in weights(jobs[0]).items())


def test_a_job_that_fails_does_not_stop_the_others(command, tmp_path):
    given = ["data", "toy", "-m", "scenes=1", "frames=2", "workers=1", "size=4,16", f"out={tmp_path / 'sweep'}"]
    finished = command(*given)
    assert finished.status == 2
    assert "size=4: must lie between 8 and 4096" in finished.err.splitlines()[-1]
    assert {path.parent.name for path in tmp_path.glob("sweep/*/toy_*")} == {"size-16"}


def test_a_finished_run_is_not_overwritten_and_not_repeated_even_with_other_numbers_of_processes(whole):
    job = whole / "seed-0"
    config = OmegaConf.to_container(OmegaConf.load(job / "config.yaml"))
    assert config["ckpt_path"] == "last"
    trainer = config["trainer"]
    evaluation = config["evaluation"]
    earlier = evaluation | {"scoring": evaluation["scoring"] | {"_target_": "completesplat.metrics.scoring.Evaluation"}}
    processes = trainer | {"devices": 2, "num_nodes": 3, "strategy": "ddp"}
    for same in (config, config | {"trainer": processes}, config | {"evaluation": earlier}):
        assert is_finished(job, same)
    for other, message in (
        ({"ckpt_path": None}, "continue it with ckpt_path=last"),
        ({"seed": 5}, "with another seed"),
        ({"trainer": trainer | {"precision": "64-true"}}, r"with another trainer\.precision"),
    ):
        with pytest.raises(CompleteSplatError, match=message):
            is_finished(job, config | other)
    assert not is_finished(whole, config)


@pytest.mark.parametrize(("name", "value"), [("LOCAL_RANK", "0"), ("SLURM_STEP_NUM_TASKS", "2")])
def test_a_sweep_is_not_started_by_each_process_of_a_launcher(command, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    assert "start it once" in command.refuses("fit", "-m", "experiment=toy_var", "seed=0,1")


NOTE = '''
import os
from pathlib import Path
from lightning import Callback

class Note(Callback):
    """Each process says what it trains."""
    def __init__(self, folder, seed):
        self.folder, self.seed = Path(folder), seed

    def on_fit_start(self, trainer, module):
        self.folder.mkdir(parents=True, exist_ok=True)
        total = sum(p.double().abs().sum().item() for p in module.parameters())
        text = f"{self.seed} {trainer.world_size} {total:.10f}"
        (self.folder / f"{os.getpid()}-{trainer.global_rank}").write_text(text)
'''


@pytest.mark.slow
def test_two_processes_a_job_train_the_same_job_and_start_no_sweep_of_their_own(toy_root, tmp_path):
    (tmp_path / "process_notes.py").write_text(NOTE)
    sweep = tmp_path / "sweep"
    note = "+callbacks.note={_target_: process_notes.Note, folder: '${out}/notes', seed: '${seed}'}"
    more = ["trainer.devices=2", "trainer.strategy=ddp", "rasterizer=reference", note]
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    program = [sys.executable, script(tmp_path), *settings(toy_root), "seed=3,4", f"out={sweep}", *more]
    done = subprocess.run(program, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]

    assert sorted(job.name for job in sweep.iterdir() if job.is_dir()) == ["seed-3", "seed-4"]
    for seed in (3, 4):
        notes = {path.name.split("-")[1]: path.read_text() for path in (sweep / f"seed-{seed}" / "notes").iterdir()}
        assert set(notes) == {"0", "1"}
        assert set(notes.values()) == {notes["0"]}
        assert notes["0"].startswith(f"{seed} 2 ")
        assert strict_json(sweep / f"seed-{seed}" / "metrics.json")["steps"] == 1


@pytest.mark.slow
def test_the_second_part_of_stage_one_is_swept_from_the_jobs_of_the_first(command, monkeypatch, toy_root, tmp_path):
    """The ablation table is two sweeps: without LPIPS differs from the full model in the second part only."""
    generator = torch.Generator().manual_seed(0)
    random = {name: 0.05 * torch.randn(value.shape, generator=generator) for name, value in blank().items()}
    vgg = saved(random, tmp_path / "vgg.pth")  # in the place of the one that would be downloaded
    monkeypatch.setattr("completesplat.losses.lpips.load_vgg16", lambda weights, sha256: load_vgg16(str(vgg)))
    shared = [f"data.root={toy_root}", *SMALL, "callbacks.images=null", "ablation=full,no_lpips", "seed=choice(0)"]
    one, two = tmp_path / "PART1", tmp_path / "TABLE"
    command.succeeds("fit", "-m", "experiment=toy_var", *shared, "test=false", f"out={one}")
    start = f"model.checkpoint={one}/ablation-${{hydra:runtime.choices.ablation}}+seed-${{seed}}/{LAST}"
    command.succeeds("fit", "-m", "experiment=toy_var_stage2", *shared, start, f"out={two}")

    jobs = ["ablation-full+seed-0", "ablation-no_lpips+seed-0"]
    first, second = ([weights(sweep / job) for job in jobs] for sweep in (one, two))
    assert all(torch.equal(value, first[1][name]) for name, value in first[0].items())
    for job, trained in zip(jobs, second, strict=True):
        assert OmegaConf.load(two / job / "config.yaml").model.checkpoint == str(one / job / LAST)
        assert any(not torch.equal(value, first[0][name]) for name, value in trained.items())
    assert any(not torch.equal(value, second[1][name]) for name, value in second[0].items())
    assert len((two / "summary.csv").read_text().splitlines()) >= 3


FIGURES = {"steps": 2, "val/psnr_novel": 20.5, "val/loss": None, "upper_bound": False, "test": {"x": 1.0}}


def test_a_job_returns_the_figure_that_is_asked_for_and_names_those_that_it_has(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(FIGURES | {"not_finite": ["val/loss: nan"]}))
    assert optimized(None, tmp_path) is None
    assert optimized("val/psnr_novel", tmp_path) == 20.5
    assert math.isnan(optimized("val/loss", tmp_path))
    there_are = r", there are val/psnr_novel, val/loss; did you mean val/psnr_nov"
    for name, others in (("val/psnr", there_are), ("steps", ""), ("upper_bound", ""), ("test", "")):
        with pytest.raises(CompleteSplatError, match=f"^optimized_metric={name}: no figure in .*{others}"):
            optimized(name, tmp_path)


def test_a_finished_run_is_asked_for_its_metric(command, pipeline):
    settings = ["experiment=toy_var", f"data.root={pipeline.toy}", *SMALL, "ckpt_path=last", f"out={pipeline.var}"]
    refused = command.refuses("fit", *settings, "optimized_metric=val/psnr_novl")
    assert refused.startswith("optimized_metric=val/psnr_novl: no figure in ")
    assert "val/psnr_novel" in refused


SEARCH = ["fit", "hparams_search=optuna", "experiment=toy_var", *SMALL, "callbacks.images=null", "logger=null"]
SEARCH += ["hydra.sweeper.n_trials=3", "model.background=choice(0.0,1.0)", "out=SEARCH"]
DIVERGES = '''
from lightning import Callback

class Diverges(Callback):
    """The weights of runs with a dark background are not finite."""
    def on_train_batch_end(self, trainer, module, *_):
        if module.background == 0:
            next(module.parameters()).data.fill_(float("nan"))
'''


@pytest.mark.slow
def test_a_search_by_optuna_goes_on_where_it_stopped_and_over_runs_that_diverge(command, toy_root, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
    (tmp_path / "diverging.py").write_text(DIVERGES)
    given = [*SEARCH, f"data.root={toy_root}", "+callbacks.diverges._target_=diverging.Diverges"]
    command.succeeds(*given)
    best = OmegaConf.load(tmp_path / "SEARCH/optimization_results.yaml")
    jobs = [path.parent for path in tmp_path.glob("SEARCH/*/run.json")]
    assert len(jobs) == 3
    assert all(job.name.startswith("model.background-") and "+optimizer.lr-0." in job.name for job in jobs)
    scores = [strict_json(job / "metrics.json") for job in jobs if (job / "metrics.json").is_file()]
    dark = [job for job in jobs if job.name.startswith("model.background-0.0")]
    assert 0 < len(dark) == 3 - len(scores)
    assert best.best_value == max(score["val/psnr_novel"] for score in scores)
    assert best.best_params["model.background"] == 1.0
    assert all("test" not in score for score in scores)
    summary = (tmp_path / "SEARCH/summary.md").read_text()
    assert "validation, not a test: psnr_novel" in summary
    again = command.succeeds("fit", "-m", *given[1:], "hydra.sweeper.n_trials=4")
    assert again.out.count("finished before, not repeated") == len(scores)
    assert len(list(tmp_path.glob("SEARCH/*/run.json"))) == 4


def test_optuna_is_an_extra(command):
    needed = r"by Optuna needs the extra optuna: pip install .*\[optuna\]"
    with pytest.raises(CompleteSplatError, match=needed), nearest_names("fit"):
        raise MissingConfigException("", missing_cfg_file="hydra/sweeper/optuna")
    if find_spec("hydra_plugins.hydra_optuna_sweeper") is None:
        assert command.refuses(*SEARCH).startswith("a search by Optuna needs the extra optuna: pip install ")


@pytest.mark.parametrize(("direction", "worst"), [("maximize", -math.inf), ("minimize", math.inf)])
def test_a_run_that_diverges_is_the_worst_of_a_search(monkeypatch, direction, worst):
    def diverges(*_):
        raise DivergenceError("the weights are not finite")

    search = OmegaConf.create({"mode": RunMode.MULTIRUN, "sweeper": {"direction": direction}})
    monkeypatch.setattr(jobs.HydraConfig, "get", lambda: search)
    monkeypatch.setattr(jobs, "job_folders", lambda config: (Path("a"), Path("a")))
    for result in (diverges, lambda *_: math.nan):
        monkeypatch.setattr(jobs, "run_job", result)
        assert jobs.run_trial("fit", OmegaConf.create(), "", []) == worst
    monkeypatch.setattr(jobs, "run_job", lambda *_: 20.5)
    assert jobs.run_trial("fit", OmegaConf.create(), "", []) == 20.5
    monkeypatch.setattr(jobs, "run_job", diverges)
    for other in ({"mode": RunMode.RUN}, {"sweeper": {"direction": None}}):
        search.merge_with(other)
        with pytest.raises(DivergenceError):
            jobs.run_trial("fit", OmegaConf.create(), "", [])


PYTHON = f"#!{sys.executable}\n"
SBATCH = '''"""Start all jobs of an array, or the one job, of the script of the last argument, and print the number.

They wait, as in a queue, until whoever submits them has put everything in its place.
"""
import os, re, subprocess, sys
script = sys.argv[-1]
options = dict(re.findall(r"^#SBATCH --([\\w-]+)=(\\S+)", open(script).read(), re.M))
first, last = re.match(r"(\\d+)-(\\d+)", options.get("array", "0-0")).groups()
number = str(os.getpid())
for task in range(int(first), int(last) + 1):
    tasks = options.get("ntasks-per-node", "1")
    told = {"SLURM_JOB_ID": f"{number}{task}", "SLURM_JOB_NAME": options["job-name"], "SLURM_NTASKS": tasks}
    told |= {"SLURM_NTASKS_PER_NODE": tasks, "SLURM_NNODES": options["nodes"], "SLURM_JOB_NUM_NODES": "1"}
    if "array" in options:
        told |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": str(task)}
    job = f"{number}_{task}" if "array" in options else number
    waiting = f"[ ! -e {os.path.dirname(script)}/{job}/{job}_submitted.pkl ] && kill -0 {os.getppid()}"
    run = ["bash", "-c", f"while {waiting}; do sleep 0.1; done; exec bash {script}"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.Popen(run, env=os.environ | told, start_new_session=True, **silent)
print("Submitted batch job", number)
'''
SRUN = '''"""Run a program once for each task, as srun does on one node."""
import os, subprocess, sys
count = int(os.environ["SLURM_NTASKS"])
program = sys.argv[next(i for i, argument in enumerate(sys.argv) if "/python" in argument) :]
shared = {"SLURM_STEP_NUM_TASKS": str(count), "SLURM_NODEID": "0", "SLURM_NODELIST": "localhost"}
log = sys.argv[sys.argv.index("--error") + 1]
job, task = (os.environ.get(f"SLURM_ARRAY_{name}_ID", "0") for name in ("JOB", "TASK"))
processes = []
for rank in range(count):
    told = shared | {"SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank)}
    with open(log.replace("%A", job).replace("%a", task).replace("%t", str(rank)), "w") as file:
        processes.append(subprocess.Popen(program, env=os.environ | told, stdout=file, stderr=file))
sys.exit(max(process.wait() for process in processes))
'''


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """SLURM's programs, first in the PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "sacct": "", "scontrol": "", "scancel": ""}.items():
        (folder / name).write_text(PYTHON + text)
        (folder / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")  # asked of `scontrol` by Lightning otherwise
    return folder


@pytest.mark.slow
def test_slurm_runs_the_jobs_of_a_sweep_each_with_two_processes(toy_root, tmp_path, cluster):
    out = tmp_path / "sweep"
    given = ["fit", "-m", "experiment=toy_var", f"data.root={toy_root}", *SMALL, "data.workers=0", f"out={out}"]
    given += ["trainer.max_steps=1", "callbacks.images=null", "rasterizer=reference", "trainer=slurm", "seed=0,1"]
    given += ["hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=10", "hydra.launcher.tasks_per_node=2"]
    program = [sys.executable, str(script(tmp_path)), *given, "trainer.precision=32-true"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(program, env=environment, capture_output=True, text=True, timeout=LIMIT, cwd=tmp_path)
    logs = "".join(path.read_text()[-2000:] for path in out.glob(".submitit/*/*_log.err"))
    assert done.returncode == 0, done.stderr[-3000:] + logs
    with (out / "summary.csv").open(newline="") as file:
        assert [row["seeds"] for row in csv.DictReader(file) if row["seeds"]] == ["2"]
    for seed in (0, 1):
        metrics = strict_json(out / f"seed-{seed}/metrics.json")
        assert (metrics["steps"], metrics["data.batch_per_process"]) == (1, 1)
    assert len(list(out.glob(".submitit/*/*_result.pkl"))) == 4
