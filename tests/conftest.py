"""Fixtures that several folders of tests use."""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
from filelock import FileLock
from PIL import Image, ImageOps
from support import SMALL, call, tiny_generator

from completesplat.data.pictures import photograph
from completesplat.data.toy import write_objects
from completesplat.signals import ENDING

# W&B would go on reading what later tests of the process print, and complain in their logs that its run has ended.
os.environ.setdefault("WANDB_CONSOLE", "off")

Folders = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def built_once(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Folders that all processes of a test run share: the first one that needs a folder fills it, the others wait.

    A folder that could not be filled is filled anew by whoever needs it next.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    # A worker's folder lies in that of the test run.
    base = tmp_path_factory.getbasetemp().parent if worker else tmp_path_factory.getbasetemp()

    def build(name: str, fill: Callable[[Path], object]) -> Path:
        folder, complete = base / f"shared_{name}", base / f"shared_{name}.complete"
        with FileLock(base / f"shared_{name}.lock"):
            if not complete.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                complete.touch()
        return folder

    return build


def made(out: Path, *arguments: str) -> None:
    """Run the command, which must succeed, from the folder of its output."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(out.parent)
        assert call(monkeypatch, *arguments, f"out={out}") == 0


@pytest.fixture(scope="session")
def toy_root(built_once: Folders) -> Path:
    """Root of a CO3D tree with the category `toy_objects`: 4 sequences (2 train, 1 val, 1 test), 4 frames, 32 px."""
    size = {"scenes": 4, "frames": 4, "size": 32, "seed": 0}
    return built_once("toy", lambda root: write_objects(root, **size, workers=1, progress=False))


class Pipeline(NamedTuple):
    """Both stages, trained for two steps: run directories of the real thing, with no skill."""

    toy: Path
    var: Path
    diffusion: Path

    @property
    def weights(self) -> Path:
        return self.diffusion / "weights"

    def photograph(self) -> Path:
        return sorted(self.toy.glob("*/*/images/*.jpg"))[0]


@pytest.fixture(scope="session")
def pipeline(toy_root: Path, built_once: Folders) -> Pipeline:
    def train(runs: Path) -> None:
        fit = ["fit", f"data.root={toy_root}", *SMALL]
        stage1 = runs / "var/checkpoints/last.ckpt"
        stage2 = ["experiment=toy_diffusion", f"model.autoreconstructor_checkpoint={stage1}", "sampler.steps=2"]
        made(runs / "var", *fit, "experiment=toy_var")
        made(runs / "diffusion", *fit, *stage2)

    runs = built_once("runs", train)
    return Pipeline(toy_root, runs / "var", runs / "diffusion")


@pytest.fixture(scope="session")
def packed_toys(pipeline: Pipeline, built_once: Folders) -> Path:
    """The pipeline's scenes, packed."""
    given = ["data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "workers=1"]
    return built_once("packed", lambda folder: made(folder / "store", "data", "prepare", *given)) / "store"


@pytest.fixture(scope="session")
def latent_cache(pipeline: Pipeline, packed_toys: Path, built_once: Folders) -> Path:
    """The training set, encoded by the pipeline's stage 1."""
    given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']"]
    return built_once("latents", lambda folder: made(folder / "cache", "data", "latents", *given)) / "cache"


@pytest.fixture(scope="session")
def tiny_weights(built_once: Folders) -> Path:
    """Of an untrained model for pictures of 32 x 32."""
    return built_once("weights", lambda folder: tiny_generator().save_pretrained(folder))


@pytest.fixture
def plain_signals():
    """The system's handlers, as a new process has them; trainers of other tests may have left Lightning's."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Finished(NamedTuple):
    """What a command left behind."""

    status: int
    out: str
    err: str


@pytest.fixture
def command(capfd, monkeypatch, tmp_path):
    """Run `completesplat` in this process, from an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> Finished:
        capfd.readouterr()
        status = call(monkeypatch, *arguments)
        return Finished(status, *capfd.readouterr())

    return run


@pytest.fixture
def rembg(monkeypatch):
    """rembg's interface as it is used (2.0.86): it turns pictures by their EXIF; here red is the background."""
    module = ModuleType("rembg")
    module.sessions = []

    def remove(picture, session=None):
        turned = ImageOps.exif_transpose(picture).convert("RGBA")
        pixels = np.array(turned)
        pixels[..., 3] = np.where(pixels[..., 0] > 128, 0, 255)
        return Image.fromarray(pixels)

    module.new_session, module.remove = lambda name: module.sessions.append(name), remove
    monkeypatch.setitem(sys.modules, "rembg", module)
    photograph._session.cache_clear()
    yield module
    photograph._session.cache_clear()
