"""Sweeps: one directory a job, named by what is swept; a sweep that is started again continues."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from support import SMALL, call, script, strict_json
from vgg_weights import blank, saved

from completesplat.commands.jobs import is_finished
from completesplat.errors import CompleteSplatError
from completesplat.losses.lpips import load_vgg16
from completesplat.settings.composition import LONGEST_NAME, job_name, swept_keys

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
    assert job_name("optimizer.lr", _root_=root_with("+optimizer.lr=1e-3")) == "optimizer.lr-1e-3"
    names = {job_name("data.root", _root_=root_with(f"data.root={path}")) for path in ("/a/b", "/a_b", "a/b", "ab")}
    names |= {job_name("x", _root_=root_with(f"x={'y' * 300}{end}")) for end in "ab"}
    assert len(names) == 6
    assert all(not set(name) & set("/=,") and len(name) < LONGEST_NAME + 12 for name in names)
    given = ["-m", "experiment=toy_var", "ablation=glob(*)", "seed=0,1", "levels=[0,1]", "x=range(3)", "y=choice(1)"]
    assert swept_keys(given) == ["ablation", "seed", "x", "y"]


def test_a_sweep_has_no_one_config_to_show(command):
    refused = command.refuses("fit", "-m", "experiment=toy_var", "seed=0,1", "--cfg", "job")
    assert refused == "--cfg and --info show the settings of one run: leave out -m"


@pytest.fixture(scope="module")
def whole(toy_root, tmp_path_factory) -> Path:
    """A sweep of one job that ran through."""
    sweep = tmp_path_factory.mktemp("sweeps") / "whole"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert call(monkeypatch, *settings(toy_root), "seed=choice(0)", f"out={sweep}") == 0
    return sweep


def test_a_sweep_that_is_started_again_repeats_no_finished_job(command, toy_root, whole):
    jobs = [whole / "seed-0", whole / "seed-1"]
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
    for same in (config, config | {"trainer": trainer | {"devices": 2, "num_nodes": 3, "strategy": "ddp"}}):
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


def in_a_process_of_its_own(arguments: list[str], folder: Path) -> None:
    """Run the command as a shell would, with the modules in a folder at hand."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    program = [sys.executable, script(folder), *arguments]
    done = subprocess.run(program, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]


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
    in_a_process_of_its_own([*settings(toy_root), "seed=3,4", f"out={sweep}", *more], tmp_path)

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
