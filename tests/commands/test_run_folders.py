"""One process at a time in a run's folder, and a run goes on with the data that it began with."""

import json
import os
import shutil
import signal
import subprocess
import sys

import pytest
from omegaconf import OmegaConf
from support import SMALL, interrupted_at, strict_json

from completesplat.commands import continuing
from completesplat.commands.locks import hold_job_lock
from completesplat.data.toy import write_objects
from completesplat.errors import CompleteSplatError
from completesplat.files import atomic_path
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.weights import RUN_CHECKPOINT

# Its child, as a loader's worker, outlives it for a while.
HOLDER = """
import os, sys, time
from pathlib import Path
from completesplat.commands.locks import hold_job_lock
with hold_job_lock(*[Path(sys.argv[1])] * 2):
    if os.fork() == 0:
        time.sleep(900)
        os._exit(0)
    print("held", flush=True)
    time.sleep(900)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that is at work in the folder `run`."""
    (tmp_path / "run").mkdir()
    program = [sys.executable, "-c", HOLDER, str(tmp_path / "run")]
    process = subprocess.Popen(program, stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    yield process
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()


@pytest.mark.processes
def test_a_second_process_is_refused_until_the_first_is_gone(command, toy_root, tmp_path, holder):
    given = ["data", "stats", "data=toy_objects", f"data.root={toy_root}", f"out={tmp_path}/run"]
    named = f"process {holder.pid} on {os.uname().nodename}"
    assert command.refuses(*given).startswith(f"{tmp_path}/run: {named} is at work in it: ")
    assert not (tmp_path / "run/config.yaml").exists()

    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    for _ in range(2):  # also after a process that ended by itself
        command.succeeds(*given)
    assert (tmp_path / "run/.lock").read_text().split()[0] == str(os.getpid())


@pytest.mark.parametrize("out", ["file", "file/below", "/dev/null", "x" * 300])
def test_what_cannot_be_a_folder_is_refused_as_one(command, tmp_path, out):
    (tmp_path / "file").write_text("kept")
    assert command.refuses("data", "toy", "scenes=1", "size=16", f"out={out}").startswith(f"{out}: cannot be used: ")
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("kind", ["folder", "link", "link to nothing"])
def test_a_lock_that_is_no_file_is_refused(tmp_path, kind):
    lock, target = tmp_path / "run/.lock", tmp_path / "target"
    lock.parent.mkdir()
    if kind == "folder":
        lock.mkdir()
    else:
        lock.symlink_to(target)
    if kind == "link":
        target.write_text("kept")
    refusal = pytest.raises(CompleteSplatError, match=r"run/\.lock: is a link or a folder")
    with refusal, hold_job_lock(lock.parent, lock.parent):
        pass
    assert (target.read_text() == "kept") if kind == "link" else not target.exists()


def test_a_removed_working_folder_is_named(command, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for given in (["data", "toy"], ["fit", "--help"]):
        assert command.refuses(*given) == "the working folder was removed: go to another folder"


def test_unfinished_files_of_a_killed_process_are_removed_and_links_are_not_followed(command, toy_root, tmp_path):
    """As `predict` leaves them below its folder. Another job's folder within is left alone while it may be at work."""
    left, of_another = tmp_path / "run/photo", tmp_path / "run/other/photo"
    for folder in (left, of_another):
        folder.mkdir(parents=True)
        with atomic_path(folder / "orbit_01.mp4") as temporary:
            temporary.touch()
        temporary.touch()  # again, as if the process had been killed before it gave the file its name
        (folder / ".mine.mp4").touch()
    (tmp_path / "run/other/.lock").touch()
    run, kept = tmp_path / "run", tmp_path / "kept"
    kept.write_text("kept")
    written = ["commands.log", "config.yaml", "run.json", "stats.json", "stats.png"]
    for name in written:
        (run / name).symlink_to(kept)
    command.succeeds("data", "stats", "data=toy_objects", f"data.root={toy_root}", "splits=[val]", f"out={run}")
    assert sorted(path.name for path in left.iterdir()) == [".mine.mp4", "orbit_01.mp4"]
    assert temporary.is_file()
    assert kept.read_text() == "kept"
    assert not any((run / name).is_symlink() for name in written)


def test_only_the_end_of_a_run_may_move_and_its_record_keeps_the_earlier_one(tmp_path):
    """In the folder of a run that trained 20 steps; for what then is trained, see the slow test of exact resuming."""
    for name, content in (("run.json", {"started": "then", "command": ["first"]}), ("metrics.json", {"steps": 20})):
        (tmp_path / name).write_text(json.dumps(content))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / RUN_CHECKPOINT).touch()

    def config(rate=1, test=False, **end):
        trainer, model = {"max_steps": 20, "max_time": None} | end, {"_target_": "a.A", "optimizer": {"lr": rate}}
        return {"ckpt_path": "last", "test": test, "optimizer": {"lr": rate}, "trainer": trainer, "model": model}

    OmegaConf.save(config(), tmp_path / "config.yaml")
    assert continuing.is_finished(tmp_path, config())
    # A setting of later versions, which the run did not have, may be there if it is off.
    for off in (0.0, None, False):
        assert continuing.is_finished(tmp_path, config() | {"later": off})
    with pytest.raises(CompleteSplatError, match="a run with another later: "):
        continuing.is_finished(tmp_path, config() | {"later": 0.5})
    for longer in ({"max_steps": 40, "test": True}, {"max_steps": -1}, {"max_time": {"hours": 1}, "max_steps": 21}):
        assert not continuing.is_finished(tmp_path, config(**longer))
    (moved := tmp_path / "moved").mkdir()
    (moved / "checkpoints").mkdir()
    (moved / RUN_CHECKPOINT).touch()
    placed = {out: config() | {"out": str(out), "folder": f"{out}/checkpoints"} for out in (tmp_path, moved)}
    OmegaConf.save(placed[tmp_path], moved / "config.yaml")
    assert not continuing.is_finished(moved, placed[moved])
    with pytest.raises(CompleteSplatError, match="a run with another folder: "):
        continuing.is_finished(moved, placed[moved] | {"folder": "elsewhere"})
    # Another folder that begins with the same letters did not move.
    assert not continuing.differences({"a": "/r/run_data"}, {"a": "/r/run_data"}, ("/r/run", "/r/run2"))
    (moved / RUN_CHECKPOINT).rename(moved / "checkpoints/step=9.ckpt")
    with pytest.raises(CompleteSplatError, match="a run with another folder: "):
        continuing.is_finished(moved, placed[moved] | {"folder": "elsewhere"})
    shutil.rmtree(moved)
    advice = f"give all settings of {tmp_path}/run.json again, or continue in another folder"
    again = f"completesplat fit optimizer.lr=2 ckpt_path={tmp_path}/checkpoints/last.ckpt out=MORE"
    for changed, message in (
        (config(max_steps=10), r"max_steps=10: .* has 20 steps; give more"),
        (config(max_steps=40, max_epochs=3), "max_epochs=3 may end before the run in"),
        (config(test=True), f"is finished, without a test: completesplat test ckpt={tmp_path}$"),
        (config(rate=2, max_steps=40), f"another optimizer.lr: {advice}: {again}$"),
        (config(rate=2) | {"a": 1, "b": 2, "c": 3, "d": 4}, "another a, b, c and 2 more: "),
        (config() | {"test_seed": 1}, "another test_seed: "),  # only `test` and settings below it may differ
        (config() | {"model": {"_target_": "a.B"}}, "another model: choose another out=DIR"),
    ):
        with pytest.raises(CompleteSplatError, match=message):
            continuing.is_finished(tmp_path, changed, ["out=R", "optimizer.lr=2", "ckpt_path=last"])
    continuing._record(tmp_path, {"command": ["second"]}, config(max_steps=40))
    record = strict_json(tmp_path / "run.json")
    assert (record["started"], record["command"], len(record["continued"])) == ("then", ["second"], 1)
    (earlier,) = record["earlier_ends"]
    assert (earlier["command"], earlier["trainer.max_steps"]) == (["first"], 20)
    assert {path.name for path in tmp_path.glob("metrics*")} == {"metrics_20_steps.json"}
    (tmp_path / "metrics_20_steps.json").rename(tmp_path / "metrics.json")
    (tmp_path / RUN_CHECKPOINT).unlink()
    with pytest.raises(CompleteSplatError, match=r"has no checkpoints/last\.ckpt to continue from: choose another out"):
        continuing.is_finished(tmp_path, config(max_steps=40))


FIT = [*SMALL, "experiment=toy_var", "test=false", "trainer.max_steps=2", "trainer.log_every_n_steps=1"]
FIT += ["callbacks.images=null", "callbacks.checkpoint.every_n_train_steps=1", "ckpt_path=last"]


def content(folder):
    """The files of a run and what they hold, but for its log and its lock."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in ("commands.log", ".lock")]
    return {path.relative_to(folder): path.read_bytes() for path in files}


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data_unless_that_is_allowed(command, tmp_path, monkeypatch):
    root, run = tmp_path / "data", tmp_path / "run"
    write_objects(root, scenes=4, frames=4, size=32, seed=0, workers=1, progress=False)
    given = ["fit", *FIT, "data=co3d_category", "data.category=toy_objects", "data.subset=null", "data.workers=0"]
    given += ["data.val_fraction=0.25", "data.test_fraction=0.25", f"data.root={root}", f"out={run}"]
    with interrupted_at(1, ReconstructionModule):
        assert command(*given).status == 1
    more = tmp_path / "more"
    write_objects(more, scenes=8, frames=4, size=32, seed=0, workers=1, progress=False)
    root.rename(tmp_path / "before")
    more.rename(root)

    before = content(run)
    message = f"{root}: not the training data that this run had before (2 sequences then, 5 now)"
    assert command.refuses(*given) == f"{message}; data.allow_changed=true goes on with these"
    assert content(run) == before
    command.succeeds(*given, "data.allow_changed=true")
    assert message in (run / "commands.log").read_text()
    assert strict_json(run / "metrics.json")["steps"] == 2
    assert OmegaConf.load(run / "config.yaml").data.allow_changed
    assert "finished before" in command(*given).out
    before = content(run)
    for unfit in (["trainer.devices=99"], ["trainer.strategy=none_such"]):
        assert command(*given, "trainer.max_steps=4", *unfit).status == 2
        assert content(run) == before


def test_a_refused_job_leaves_an_earlier_ones_record_and_a_first_one_leaves_its_own(command, pipeline, tmp_path):
    photo = pipeline.photograph()
    given = ["predict", "weights=toy_objects", f"out={tmp_path}/run", "video=[]", "steps=1", "samples=1"]
    command.succeeds(*given, photo)
    before = content(tmp_path / "run")
    for unfit in (["absent.jpg"], [photo, "fov=500"], [photo, "formats=[x]"]):
        assert command(*given, *unfit).status == 2
        assert content(tmp_path / "run") == before
    assert command(*given[:2], "absent.jpg", f"out={tmp_path}/first").status == 2
    assert strict_json(tmp_path / "first/run.json")["command"][2] == "absent.jpg"


@pytest.mark.parametrize(
    "experiment", ["toy_diffusion model.autoreconstructor_checkpoint", "toy_diffusion_masked model.checkpoint"]
)
def test_weights_that_must_be_given_are_not_those_of_a_run_in_the_working_folder(command, tmp_path, experiment):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/last.ckpt").touch()
    name, setting = experiment.split()
    assert command.refuses("fit", f"experiment={name}", "data.root=x").startswith(
        f"{setting} is needed: give {setting}="
    )
