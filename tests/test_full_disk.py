"""A full disk or a removed folder: one line, old files stay, and no unfinished files."""

import errno
import os
import re
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support import SMALL, some_gaussians, tiny_generator

from completesplat.commands import exit_status, refusal
from completesplat.data.toy import write_objects, write_rooms
from completesplat.data.validation.audit import AuditReport
from completesplat.errors import DiskError
from completesplat.export.images import write_png
from completesplat.export.ply import write_ply
from completesplat.export.splat import write_splat
from completesplat.export.video import write_video
from completesplat.files import make_folder, write_json, write_text
from completesplat.photo.saving import save_image
from completesplat.tensors import concatenate
from completesplat.training.checkpoints import CheckpointFiles
from completesplat.training.loggers import MetricsFile
from completesplat.training.reconstruction import ReconstructionModule

pytestmark = pytest.mark.processes
OFFSETS = 5
SAID = "cannot be written: (File too large|No space left on device)"


NOISE = torch.rand(4, 3, 64, 64, generator=torch.Generator().manual_seed(0))  # of one size, whenever it is written


@contextmanager
def quota(most: int) -> Iterator[None]:
    """Keep files of this process and its children from growing beyond `most` bytes.

    None keeps compiled modules: Python does not see that they were cut short, and no process could import them again.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "dont_write_bytecode", True)
            patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def offsets(size: int, count: int = OFFSETS) -> list[int]:
    return [round(place) for place in np.linspace(0, size - 1, count)]


def checkpoint(path: Path) -> None:
    CheckpointFiles().save_checkpoint({"state_dict": {"a": torch.arange(3000.0)}, "lists": [torch.ones(500)]}, path)


def image(path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    write_png(path, Image.fromarray(noise))


def rows(path: Path) -> None:
    """A new column: the whole file is made anew."""
    file = MetricsFile(str(path.parent))
    file.path, file.metrics = path, [{"step": step, "loss": step / 7} for step in range(300)]
    file.save()


def gaussians(count: int):
    return concatenate([some_gaussians(1)[0]] * count)


WRITERS: dict[str, Callable[[Path], object]] = {
    "last.ckpt": checkpoint,
    "metrics.csv": rows,
    "metrics.json": lambda path: write_text(path, "figures " * 500),
    "check.json": lambda path: write_json(path, AuditReport(1, 1, [], {"left out": {"ab" * 50: 1}}, {}).json()),
    "sheet.png": image,
    "sample.ply": lambda path: write_ply(path, gaussians(100)),
    "sample.splat": lambda path: write_splat(path, gaussians(100)),
    "orbit.mp4": lambda path: write_video(path, NOISE),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_does_not_fit_is_refused_and_the_old_one_stays(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path)
    size = path.stat().st_size
    path.write_bytes(b"old")
    for most in offsets(size):
        with quota(most), pytest.raises(DiskError, match=rf"{re.escape(str(path))}: {SAID}"):
            WRITERS[name](path)
        assert path.read_bytes() == b"old"
        assert list(tmp_path.iterdir()) == [path]


def test_rows_that_do_not_fit_are_refused(tmp_path):
    file = MetricsFile(str(tmp_path))
    for step in range(100):
        file.metrics = [{"step": step, "loss": 0.5}]
        file.save()
    size = file.path.stat().st_size
    for most in offsets(size):
        file.metrics = [{"step": 100, "loss": 0.5}]
        with quota(most), pytest.raises(DiskError, match=rf"metrics\.csv: {SAID}"):
            file.save()
    assert file.path.stat().st_size == size


TINY = {"scenes": 2, "frames": 2, "size": 16, "seed": 0, "workers": 1, "progress": False}
FOLDERS: dict[str, Callable[[Path], Path]] = {
    "toy_objects": lambda out: write_objects(out, **TINY),
    "toy_rooms": lambda out: write_rooms(out, **TINY),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_a_data_set_that_does_not_fit_is_refused_and_nothing_of_it_stays(tmp_path, name):
    write, out = FOLDERS[name], tmp_path / "out"
    folder = write(out)
    largest = max(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    shutil.rmtree(folder)
    for most in offsets(largest):
        with quota(most), pytest.raises(DiskError, match=rf"^{re.escape(str(folder))}: {SAID}$"):
            write(out)
        assert [path.name for path in out.iterdir()] == [f".{name}.lock"]
    assert write(out).is_dir()


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_an_image_that_does_not_fit_is_not_cut_short(tmp_path, suffix):
    with quota(100), pytest.raises(OSError, match=rf"Errno {errno.EFBIG}"):
        save_image(Image.effect_noise((64, 64), 50), tmp_path / f"a{suffix}")


def test_weights_that_do_not_fit_are_refused_and_the_old_ones_stay(tmp_path):
    model = tiny_generator()
    model.save_pretrained(tmp_path)
    old = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with quota(10_000), pytest.raises(DiskError, match=rf"model\.safetensors: {SAID}"):
        model.save_pretrained(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == old


def test_a_folder_that_is_gone_does_not_come_back(tmp_path):
    gone = tmp_path / "run"
    # The logger of rows makes its folder when a run begins.
    for write in ({**WRITERS, "metrics.csv": make_folder}).values():
        with pytest.raises(DiskError, match=r"is not there") as caught:
            write(gone / "file.mp4")
        assert "\n" not in str(caught.value)
    assert not gone.exists()


def line(finished) -> str:
    assert finished.status in (1, 2)
    errors = [one for one in finished.err.splitlines() if one.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in finished.err
    return errors[0]


FIT = [*SMALL, "experiment=toy_var", "test=false", "trainer.max_steps=4", "trainer.log_every_n_steps=1"]
FIT += ["callbacks.images=null", "callbacks.checkpoint.every_n_train_steps=2"]


def test_training_stops_where_its_checkpoint_does_not_fit(command, pipeline, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/commands.log").write_bytes(b"-" * 60_000)  # nor does what is logged, of which nothing is said
    with quota(60_000):
        finished = command("fit", *FIT, f"data.root={pipeline.toy}", f"out={tmp_path}/run")
    assert re.fullmatch(rf"error: {tmp_path}/run/checkpoints/last\.ckpt: {SAID}", line(finished))
    assert list((tmp_path / "run/checkpoints").iterdir()) == []
    command.succeeds("fit", *FIT, f"data.root={pipeline.toy}", f"out={tmp_path}/run", "ckpt_path=last")


def test_training_stops_where_its_folder_was_removed(command, pipeline, tmp_path, monkeypatch):
    step, run = ReconstructionModule.training_step, tmp_path / "run"

    def removed(self, *inputs):
        if self.global_step == 1:
            shutil.rmtree(run)
        return step(self, *inputs)

    monkeypatch.setattr(ReconstructionModule, "training_step", removed)
    finished = command("fit", *FIT, f"data.root={pipeline.toy}", f"out={run}")
    assert line(finished) == f"error: {run}/metrics.csv: cannot be written, {run} is not there"
    assert not run.exists()


def test_prepared_data_and_latents_that_do_not_fit(command, pipeline, packed_toys, tmp_path):
    prepare = ["data", "prepare", "data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "workers=1"]
    latents = ["data", "latents", f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}"]
    latents += [f"overrides=['data.root={packed_toys}']"]
    for given, name, most in ((prepare, r"train-00000-of-00001\.arrow", 6000), (latents, r"latents\.arrow", 4000)):
        out = tmp_path / given[1]
        with quota(most):
            finished = command(*given, f"out={out}")
        assert re.fullmatch(rf"error: {out}/{name}: {SAID}", line(finished))
        assert [path.name for path in out.iterdir() if path.suffix in (".arrow", ".npy", ".unfinished")] == []
        assert command(*given, f"out={out}").status == 0


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_folder_that_cannot_be_made_is_named_whoever_makes_it(tmp_path, number):
    error = Exception("Error in call to target")
    error.__cause__ = OSError(number, os.strerror(number), str(tmp_path / "new"))
    message = refusal(error) or ""
    assert message.startswith(f"{tmp_path}/new: ")
    assert os.strerror(number) in message
    assert exit_status(error) == 1
    # What is not there, or may not be read, is a fault of its own; and a file without a name is better shown with all.
    assert refusal(FileNotFoundError(errno.ENOENT, "no such file", "x")) is None
    assert refusal(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))) is None
